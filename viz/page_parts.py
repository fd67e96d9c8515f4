"""Figures of a page as data addresses, which need nothing beside it."""

import base64
import io

from matplotlib.figure import Figure


def svg(figure: Figure) -> str:
    """A figure as a data address, drawn by lines."""
    return svg_address(svg_text(figure))


def svg_text(figure: Figure) -> str:
    """A figure as the text of an SVG file."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def svg_address(text: str) -> str:
    """The text of an SVG file as a data address."""
    return _address("svg+xml", text.encode())


def png(figure: Figure, dpi: int) -> str:
    """A figure as a data address, drawn by pixels."""
    return _address("png", png_bytes(figure, dpi))


def png_bytes(figure: Figure, dpi: int) -> bytes:
    """A figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
