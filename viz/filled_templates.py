"""Templates of pages filled in, without the libraries that draw."""

import json

from jinja2 import Environment, PackageLoader, select_autoescape
from markupsafe import Markup

from viz.unbroken import unbroken


def render(template: str, **content: object) -> str:
    """A template of `viz/templates` filled in; text is escaped, and numbers stay with their units."""
    environment = Environment(
        loader=PackageLoader("viz"), autoescape=select_autoescape(default=True), trim_blocks=True, finalize=_on_one_line
    )
    return environment.get_template(template).render(**content)


def _on_one_line(value: object) -> object:
    """Text as a page has it; what is markup already was text before."""
    return unbroken(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def script_json(data: object) -> str:
    """Plain data as JSON that may stand inside a script element."""
    return json.dumps(data).replace("<", "\\u003c")
