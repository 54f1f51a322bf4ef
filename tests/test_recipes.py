"""Every recipe in the repository can be read."""

from pathlib import Path

import pytest

from lfd.about import about
from tests.conftest import ROOT

RECIPES = [path for folder in ("datasets", "policies", "robot_configs") for path in sorted((ROOT / folder).iterdir())]


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.name)
def test_recipe_loads(path: Path) -> None:
    if path.suffix == ".md":
        return
    assert path.suffix == ".toml", "recipes and cards only: a Python file here would shadow a library"
    assert about(path)["kind"] == "recipe"
