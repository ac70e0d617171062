"""Render the Jinja2 templates of `data_tools`; every value is escaped for HTML unless it is `Markup`."""

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render_template(package: str, name: str, **values: Any) -> str:
    """Render `assets/NAME` of a package. An undefined variable raises `jinja2.UndefinedError`."""
    environment = Environment(
        loader=PackageLoader(package, "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name).render(**values)
