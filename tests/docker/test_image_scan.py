"""The scan of an image finds what must not be in one."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import pytest
from image_scan import USER, Findings, scan

KEY = b"-----BEGIN RSA PRIVATE KEY-----\n" + b"A" * 64 + b"\n-----END RSA PRIVATE KEY-----\n"
BASE = [("usr/bin/su", {"mode": 0o755}, b"program"), ("usr/lib/selftest", {}, KEY), ("tmp", {"mode": 0o1777}, None)]
OURS = [
    ("opt/optipmb/bin/optipmb", {"mode": 0o755}, b"program"),
    ("var/lib/optipmb", {"mode": 0o750, "uid": USER, "gid": USER}, None),
]
Entry = tuple[str, dict[str, int], bytes | None]


def layer(entries: list[Entry]) -> bytes:
    """A layer with files, and folders where there is no content."""
    written = io.BytesIO()
    with tarfile.open(fileobj=written, mode="w") as tar:
        for name, rights, content in entries:
            entry = tarfile.TarInfo(name)
            entry.type = tarfile.REGTYPE if content is not None else tarfile.DIRTYPE
            entry.size = len(content or b"")
            entry.mode = rights.get("mode", 0o644)
            entry.uid, entry.gid = rights.get("uid", 0), rights.get("gid", 0)
            tar.addfile(entry, io.BytesIO(content or b""))
    return written.getvalue()


def look(folder: Path, *layers: list[Entry], config: dict[str, Any] | None = None) -> Findings:
    files = {f"{number}.tar": layer(entries) for number, entries in enumerate([BASE, *layers])}
    manifest = [{"Config": "config.json", "Layers": list(files)}]
    files |= {
        "config.json": json.dumps({"config": config or {}}).encode(),
        "manifest.json": json.dumps(manifest).encode(),
    }
    with tarfile.open(folder / "image.tar", "w") as tar:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    return scan(folder / "image.tar", 1, ["index.example"])


def test_a_clean_image(tmp_path: Path) -> None:
    """Nothing is found in one that is as it should be, whose base has a key for trials of its own."""
    found = look(tmp_path, OURS)
    assert (found.wrong, found.files) == ([], 5)
    assert found.added == len(b"program")


@pytest.mark.parametrize(
    ("name", "rights", "content", "said"),
    [
        ("usr/bin/chsh", {"mode": 0o4755}, b"x", "/usr/bin/chsh runs as its owner"),
        ("usr/bin/wall", {"mode": 0o2755}, b"x", "/usr/bin/wall runs as its group"),
        ("opt/optipmb/lib/a.py", {"mode": 0o666}, b"x", "can be written by everybody"),
        ("srv/open", {"mode": 0o777}, None, "can be written by everybody"),
        ("opt/optipmb/lib/b.py", {"uid": USER}, b"x", "can be written by the service"),
        ("etc/settings", {"gid": USER, "mode": 0o664}, b"x", "can be written by the service"),
        ("opt/optipmb/lib/c.py", {"gid": 50, "mode": 0o664}, b"x", "is not root's alone"),
        ("etc/pip.conf", {}, b"", "/etc/pip.conf is a file of whoever builds"),
        ("root/.netrc", {}, b"x", "is a file of whoever builds"),
        ("opt/optipmb/share/k.pem", {}, KEY, "has a private key"),
        ("opt/optipmb/share/t", {}, b"token=ghp_" + b"a1B2" * 9, "has a token"),
        ("opt/optipmb/share/u", {}, b"https://builder:0123456789@packages.example/simple", "has a name and a password"),
        ("opt/optipmb/share/d.json", {}, b'{"url": "https://index.example/simple/x"}', "has the host index.example"),
    ],
)
def test_what_must_not_be_there(tmp_path: Path, name: str, rights: dict[str, int], content: bytes, said: str) -> None:
    """Each file that others can write, that runs as somebody else, or that holds a secret, is one line."""
    found = look(tmp_path, [*OURS, (name, rights, content)])
    assert len(found.wrong) == 1
    assert said in found.wrong[0]


def test_a_secret_that_an_upper_layer_removes(tmp_path: Path) -> None:
    """It can still be read from the lower layer, so it is found; rights of removed files do not matter."""
    lower: list[Entry] = [("root/k.pem", {}, KEY), ("usr/bin/su", {"mode": 0o4755}, b"x")]
    found = look(tmp_path, OURS, lower, [("root/.wh.k.pem", {}, b""), ("usr/bin/.wh.su", {}, b"")])
    assert found.wrong == ["/root/k.pem has a private key at byte 0"]


def test_variables_and_labels(tmp_path: Path) -> None:
    """A password in the environment and a private host in a label are found."""
    config = {"Env": ["PATH=/bin", "API_KEY=x"], "Labels": {"from": "index.example"}}
    found = look(tmp_path, OURS, config=config)
    assert found.wrong == ["the variable API_KEY is set", "the image's configuration has the host index.example"]
