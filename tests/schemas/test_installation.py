"""The commands that messages and pages give to install an extra."""

import json
import re
import shlex
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from optipmb_schemas.installation import install_command
from optipmb_tools.extras import _EXTRAS

ROOT = Path(__file__).parents[2]
WHEEL = "optipmb-0.1.0-py3-none-any.whl"
METADATA = "Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\nProvides-Extra: table\n"


def installed(folder: Path, origin: object = None, name: str = "optipmb") -> None:
    """Write what pip leaves of a distribution, which came from `origin`; None: from an index."""
    info = folder / f"{name.replace('-', '_')}-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(METADATA.format(name=name))
    if origin is not None:
        (info / "direct_url.json").write_text(json.dumps(origin))


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (None, "pip install 'optipmb[table]'"),
        ({"url": "file:///a/clone", "dir_info": {}}, "pip install '/a/clone[table]'"),
        ({"url": "file:///a%20b/clone", "dir_info": {"editable": True}}, "pip install -e '/a b/clone[table]'"),
        ({"url": f"file:///dist/{WHEEL}", "archive_info": {}}, f"pip install '/dist/{WHEEL}[table]'"),
        ({"url": f"https://h/{WHEEL}", "archive_info": {}}, f"pip install 'optipmb[table] @ https://h/{WHEEL}'"),
        ({"url": "https://h/o.git", "vcs_info": {"vcs": "git"}}, "pip install 'optipmb[table] @ git+https://h/o.git'"),
    ],
)
def test_the_command_names_what_was_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, origin: object, command: str
) -> None:
    """A checkout, a wheel and a repository are named by their place; only a package of an index by its name alone."""
    installed(tmp_path, origin)
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    assert install_command("table") == command


def test_a_node_is_told_its_own_distribution(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where only `optipmb-node` is installed, the command is about it; without both about `optipmb`."""
    installed(tmp_path / "node", name="optipmb-node")
    monkeypatch.setattr(sys, "path", [str(tmp_path / "node")])
    assert install_command("grpc") == "pip install 'optipmb-node[grpc]'"
    monkeypatch.setattr(sys, "path", [])
    assert install_command("grpc") == "pip install 'optipmb[grpc]'"


def test_pip_takes_the_command_of_a_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the wheel at its place, pip accepts the command as it stands, and knows the extra."""
    with zipfile.ZipFile(tmp_path / WHEEL, "w") as wheel:
        info = "optipmb-0.1.0.dist-info"
        wheel.writestr(f"{info}/METADATA", METADATA.format(name="optipmb"))
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", "")
    installed(tmp_path / "site", {"url": (tmp_path / WHEEL).as_uri(), "archive_info": {}})
    with monkeypatch.context() as patched:
        patched.setattr(sys, "path", [str(tmp_path / "site")])
        words = shlex.split(install_command("table"))
    quiet = ["--dry-run", "--no-deps", "--no-index", "--ignore-installed", "--disable-pip-version-check"]
    done = subprocess.run([sys.executable, "-m", *words, *quiet], capture_output=True, text=True, check=False)
    assert "Would install optipmb-0.1.0" in done.stdout, done.stderr
    assert "does not provide the extra" not in done.stderr


def test_every_hint_names_an_extra_and_works_in_a_checkout() -> None:
    """Messages give no name of an index, pages paths of a checkout, and each extra is one of its distribution."""
    known = {
        place: set(tomllib.loads((ROOT / place / "pyproject.toml").read_text())["project"]["optional-dependencies"])
        for place in (".", "./node")
    }
    sources = [path for part in ("optipmb", "schemas", "service", "clients") for path in (ROOT / part).rglob("*.py")]
    text = "\n".join(path.read_text() for path in sources)
    assert not re.search(r"pip install [^\n]*optipmb", text)
    calls = r"install_command\('(\w+)'\)|_needed\([^)]*, \"(\w+)\"\)|needed\(\"[^\"]*\", \"(\w+)\""
    extras = set(re.findall(calls, text))
    assert len(extras) > 5
    assert {name for found in extras for name in found if name} | set(_EXTRAS) <= known["."]
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "examples/cluster.sh"]
    hints = [
        (page.name, hint)
        for page in pages
        for hint in re.findall(r"(?:pipx?|tool) install (?:-e )?('[^']+'|[^\s`]+)", page.read_text())
    ]
    assert len(hints) > 10
    for page, hint in hints:
        found = re.fullmatch(r"(\.|\./node)(?:\[([\w,]+)\])?", hint.strip("'"))
        assert found, f"{page}: {hint} is no path of a checkout"
        assert set((found[2] or "").split(",")) - {""} <= known[found[1]], f"{page}: {hint}"
