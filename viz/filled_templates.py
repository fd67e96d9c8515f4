"""Templates of pages filled in, without the libraries that draw."""

import json

from jinja2 import Environment, PackageLoader, select_autoescape


def render(template: str, **content: object) -> str:
    """A template of `viz/templates` filled in; text is escaped."""
    environment = Environment(loader=PackageLoader("viz"), autoescape=select_autoescape(default=True), trim_blocks=True)
    return environment.get_template(template).render(**content)


def script_json(data: object) -> str:
    """Plain data as JSON that may stand inside a script element."""
    return json.dumps(data).replace("<", "\\u003c")
