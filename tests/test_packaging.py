"""The distribution: its packages, its version, its changelog."""

import re
import sys
import tomllib
from pathlib import Path

import pytest

import facet
import facet_protocol

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_changelog_is_at_the_version() -> None:
    version = PROJECT["project"]["version"]
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert next(h for h in headings if h != "Unreleased") == version
    assert facet.__version__ == version


def test_the_packages_are_ours() -> None:
    """Not those of an installed distribution of the same name."""
    packages = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert packages == ["service/facet", "protocol/facet_protocol"]
    for module, package in zip((facet, facet_protocol), packages, strict=True):
        assert module.__file__ is not None
        assert Path(module.__file__).parent == ROOT / package
        assert (ROOT / package / "py.typed").exists()


@pytest.mark.parametrize("folder", ["service", "protocol", "docker", "recordings", "tests"])
def test_folders_are_no_packages(folder: str) -> None:
    """As import names they would collide with installed ones."""
    assert not (ROOT / folder / "__init__.py").exists()


def test_every_dependency_says_why() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    block = text.split("\ndependencies = [\n")[1].split("\n]")[0]
    assert all(re.search(r'", +# \w', line) for line in block.splitlines())


def test_this_python_is_one_we_promise() -> None:
    assert PROJECT["project"]["requires-python"] == ">=3.11"
    assert sys.version_info >= (3, 11)
