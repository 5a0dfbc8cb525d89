"""Looks through an image, layer by layer: who may write what, who runs as whom, and what should not be in there."""

from __future__ import annotations

import json
import re
import stat
import tarfile
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import IO, TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

USER: Final = 10001
VOLUME: Final = "var/lib/optipmb"
OURS: Final = "opt/optipmb/"
WHITEOUT: Final = ".wh."
LARGEST: Final = 256 * 2**20
"""Bytes of a file that are looked through; none is larger."""

NAMES: Final = re.compile(
    r"(^|/)(\.pypirc|pip\.conf|\.netrc|\.npmrc|\.git|\.git-credentials|\.env|id_(rsa|dsa|ecdsa|ed25519)|\.aws|\.ssh"
    r"|\.docker|ca\.crt|.*\.key|.*\.p12|.*\.pfx)$"
)
"""Files that hold settings, keys and passwords of the person who builds."""
CONTENTS: Final = {
    "a private key": re.compile(rb"-----BEGIN [A-Z ]{0,20}PRIVATE KEY-----\s+[A-Za-z0-9+/=]{40}"),
    "a token": re.compile(
        rb"\b(?:gh[pousr]_[A-Za-z0-9]{36}|github_pat_\w{40}|glpat-[\w-]{20}|pypi-AgEIcHlwaS5vcmc[\w-]{40}|npm_[A-Za-z0-9]{36}"
        rb"|AKIA[0-9A-Z]{16}|xox[bap]-[0-9]{8,}-[\w-]{10,})\b"
    ),
    "a name and a password in an address": re.compile(
        rb"https?://[\w.%-]{1,64}:(?!pass|pw\b|secret|REDACTED@)[\w.%-]{8,64}@[\w-]+\.\w"
    ),
}
SETTING: Final = re.compile(r"(?i)(password|passwd|secret|token|api_?key|credential)")
"""Names of variables that should not be set in an image."""


@dataclass
class Findings:
    """Scanned files and the problems found.

    Attributes:
        files: files and folders of the image.
        bytes: what all layers hold.
        added: what the layers beyond the base image hold.
        wrong: a line for each finding.
    """

    files: int = 0
    bytes: int = 0
    added: int = 0
    wrong: list[str] = field(default_factory=list)


def scan(archive: Path, base_layers: int, hosts: Sequence[str] = ()) -> Findings:
    """Look through an image that was saved as an archive.

    Args:
        archive: what `save` writes.
        base_layers: how many layers are the base image's, which is as its publishers have it: secrets are looked for
            in the others, rights in all.
        hosts: names of machines that must not occur, such as a private package index.
    """
    patterns = CONTENTS | {f"the host {host}": re.compile(re.escape(host.encode())) for host in hosts}
    findings = Findings()
    seen: dict[str, tarfile.TarInfo] = {}
    with tarfile.open(archive) as image:
        manifest = json.load(_member(image, "manifest.json"))[0]
        for number, name in enumerate(manifest["Layers"]):
            ours = number >= base_layers
            with tarfile.open(fileobj=_member(image, name)) as layer:
                for entry, path in _entries(layer):
                    _apply(seen, entry, path)
                    findings.bytes += entry.size
                    if ours:
                        findings.added += entry.size
                        findings.wrong += _secrets(layer, entry, path, patterns)
        config = json.load(_member(image, manifest["Config"]))
    findings.files = len(seen)
    findings.wrong += [line for path, entry in sorted(seen.items()) for line in _rights(path, entry)]
    findings.wrong += _settings(config, patterns)
    return findings


def _member(image: tarfile.TarFile, name: str) -> IO[bytes]:
    opened = image.extractfile(name)  # follows links, as some engines write layers twice
    if opened is None:
        raise ValueError(f"the archive has no file {name}")
    return opened


def _entries(layer: tarfile.TarFile) -> Iterator[tuple[tarfile.TarInfo, str]]:
    for entry in layer:
        yield entry, str(PurePosixPath(entry.name)).lstrip("/")


def _apply(seen: dict[str, tarfile.TarInfo], entry: tarfile.TarInfo, path: str) -> None:
    """Lay an entry over what lower layers have."""
    folder, _, name = path.rpartition("/")
    if not name.startswith(WHITEOUT):
        seen[path] = entry
        return
    gone = folder if name == ".wh..wh..opq" else f"{folder}/{name.removeprefix(WHITEOUT)}".lstrip("/")
    for known in [known for known in seen if known == gone or known.startswith(f"{gone}/")]:
        if known != folder:
            del seen[known]


def _rights(path: str, entry: tarfile.TarInfo) -> Iterator[str]:
    """Return the problem with owner and mode of a file: all but the volume is root's, and only root writes it."""
    if entry.issym():
        return
    mode = entry.mode
    sticky = entry.isdir() and mode & stat.S_ISVTX
    if entry.isreg() and mode & (stat.S_ISUID | stat.S_ISGID):
        yield f"/{path} runs as {'its owner' if mode & stat.S_ISUID else 'its group'} ({mode:o})"
    if mode & stat.S_IWOTH and not sticky and not entry.isdev():
        yield f"/{path} can be written by everybody ({mode:o})"
    elif path != VOLUME and (entry.uid == USER or (entry.gid == USER and mode & stat.S_IWGRP)):
        yield f"/{path} can be written by the service"
    elif path.startswith(OURS) and (entry.uid or entry.gid or mode & stat.S_IWGRP):
        yield f"/{path} is not root's alone ({entry.uid}:{entry.gid} {mode:o})"


def _secrets(
    layer: tarfile.TarFile, entry: tarfile.TarInfo, path: str, patterns: dict[str, re.Pattern[bytes]]
) -> Iterator[str]:
    """What a file should not hold, in whichever layer: what an upper one removes can still be read."""
    if NAMES.search(path) and not entry.isdir():
        yield f"/{path} is a file of whoever builds"
    if not entry.isreg() or not entry.size:
        return
    if entry.size > LARGEST:
        yield f"/{path} is too large to be looked through ({entry.size} bytes)"
        return
    opened = layer.extractfile(entry)
    content = opened.read() if opened else b""
    for what, pattern in patterns.items():
        if found := pattern.search(content):
            yield f"/{path} has {what} at byte {found.start()}"


def _settings(config: dict[str, Any], patterns: dict[str, re.Pattern[bytes]]) -> Iterator[str]:
    """What variables, labels and the history of the image should not say."""
    for variable in config.get("config", {}).get("Env") or []:
        name, _, value = variable.partition("=")
        if SETTING.search(name) and value:
            yield f"the variable {name} is set"
    text = json.dumps(config).encode()
    for what, pattern in patterns.items():
        if pattern.search(text):
            yield f"the image's configuration has {what}"
