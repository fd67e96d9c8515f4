"""A screenshot as a picture of few colours, a third of the bytes: grounds stay even, colour bars whole."""

from PIL import Image

_COLOURS = 256


def few_colours(picture: Image.Image) -> Image.Image:
    """With a palette that has rare colours too: the median cut gives them to the large areas."""
    return picture.convert("RGB").quantize(
        _COLOURS, method=Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE
    )
