"""Jinja2 templates of the report: HTML and SVG text from data. Every value is escaped unless it is `Markup`."""

from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

ASSETS_DIR = Path(__file__).parent / "assets"


@cache
def template_environment() -> Environment:
    """Return the environment of all templates in `assets/`; an undefined variable is an error."""
    return Environment(
        loader=FileSystemLoader(ASSETS_DIR),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render_template(name: str, **values: Any) -> Markup:
    """Return a rendered template; the result is safe to insert into another one."""
    return Markup(template_environment().get_template(name).render(**values))


def render_macro(name: str, *values: Any) -> Markup:
    """Return the result of a macro of `macros.html.j2`."""
    module: Any = template_environment().get_template("macros.html.j2").module
    return Markup(getattr(module, name)(*values))


def read_asset(name: str) -> str:
    """Return the text of a style sheet or a script."""
    return (ASSETS_DIR / name).read_text(encoding="utf-8")
