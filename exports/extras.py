"""The check for packages that only an export needs."""

from __future__ import annotations

from importlib.util import find_spec

from common.errors import BadInput


def need(feature: str, *packages: str):
    """Raise BadInput with one line that says what to install, if a package is missing."""
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise BadInput(f"{feature} needs {' and '.join(missing)}: pip install -r requirements-extras.txt")
