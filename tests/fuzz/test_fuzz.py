"""The decoders stand every file of the corpora and everything that a search ever found (`make fuzz` searches on)."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest
from optipmb_service.session.checkpoint import decode_checkpoint

FOLDER = Path(__file__).parent


def _load(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


mutation, targets = _load("mutation"), _load("targets")
FILES = sorted(path for place in ("corpus", "found") for path in FOLDER.glob(f"{place}/*/*"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: "/".join(path.parts[-3:]))
def test_known_bytes_are_read_or_refused(path: Path) -> None:
    """They are read and usable, or refused with the one error of the decoder; nothing else is raised."""
    targets.TARGETS[path.parent.name](path.read_bytes())


@pytest.mark.parametrize("name", ["empty", "window"])
def test_a_search_of_checkpoints_begins_with_some_that_are_taken_up(name: str) -> None:
    """A decoder that refuses every seed is not searched (`python tests/fuzz/seeds.py` writes them again)."""
    decode_checkpoint(targets.seal((FOLDER / "corpus" / "checkpoints" / name).read_bytes(), targets.Incarnation()))


@pytest.mark.parametrize("name", ["messages/Detections.msgpack", "messages/Detections.json", "checkpoints/window"])
def test_changes_leave_whole_maps(name: str) -> None:
    """What the search makes of a map mostly is one again, so that it looks at values; equal seeds change it equally."""
    path = FOLDER / "corpus" / name
    data, head = path.read_bytes(), targets.HEADS[path.parent.name]

    def made() -> list[bytes]:
        return [mutation.mutated(data, 2 * len(data), seed, lambda one, _: one, head=head) for seed in range(60)]

    changed = made()
    assert changed == made()
    assert len(set(changed)) > 20
    assert all(one[:head] == data[:head] for one in changed)
    assert sum(mutation._read(one[head:]) is not None for one in changed) > 50
