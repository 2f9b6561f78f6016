"""What is handed out: one number everywhere, archives that hold what they should, types that users see."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import rcorefine as rco

ROOT = Path(__file__).resolve().parent.parent


def test_the_number_of_the_release_is_the_same_everywhere():
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    number, date = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", changes, flags=re.MULTILINE)[0]
    cited = dict(
        re.findall(r'^([\w-]+): "?([^"\n]+)"?$', (ROOT / "CITATION.cff").read_text(), flags=re.MULTILINE)
    )
    assert (rco.__version__, rco.__version__) == (number, cited["version"])
    assert cited["date-released"] == date


def test_the_users_script_that_mypy_reads_has_every_public_name():
    tree = ast.parse((ROOT / "tests" / "users_script.py").read_text(encoding="utf-8"))
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "rco"
    }
    assert used == set(rco.__all__)
    assert 'files = ["rcorefine", "tests/users_script.py"]' in (ROOT / "pyproject.toml").read_text()


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """Names in the wheel, and in the sdist without its first folder."""
    pytest.importorskip("hatchling", reason="hatchling builds the archives")
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", folder], cwd=ROOT, check=True, timeout=120
    )
    wheel, sdist = *folder.glob("*.whl"), *folder.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as file, tarfile.open(sdist) as tar:
        return set(file.namelist()), {name.partition("/")[2] for name in tar.getnames()}


def test_the_wheel_is_the_package_and_nothing_else(archives):
    there = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "rcorefine").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.name != "conftest.py"
    }
    beside = {name for name in archives[0] if f"rcorefine-{rco.__version__}.dist-info" in name}
    assert archives[0] - beside == there
    assert {"rcorefine/py.typed", "rcorefine/__init__.pyi"} <= there
    assert any(name.endswith("licenses/LICENSE") for name in beside)


def test_the_sdist_can_be_tested_and_holds_nothing_that_is_made(archives):
    wanted = ("pyproject.toml", "README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "tests/conftest.py",
              "rcorefine/conftest.py", "docs/start.md", "benchmarks/__main__.py",
              *(str(path.relative_to(ROOT)) for path in (ROOT / "notebooks").glob("*.*")))  # fmt: skip
    assert set(wanted) <= archives[1]
    made = re.compile(r"(^docs/(_build|gallery|notebooks|reference/generated)/)|__pycache__|\.nb[ic]$")
    assert not [name for name in archives[1] if made.search(name)]
