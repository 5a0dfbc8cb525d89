"""Reads a Dockerfile: instructions in order, variables put in, stages apart. What this one uses, nothing more."""

import json
import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Instruction:
    """One instruction of a stage, with the environment that holds there.

    Attributes:
        name: in capitals.
        value: what follows, variables of ARG and ENV put in; a shell's own stay for RUN.
        environment: what ENV and ARG say at that point.
    """

    name: str
    value: str
    environment: dict[str, str]

    @property
    def words(self) -> list[str]:
        """The value as a list: as JSON where it is written so, else as a shell splits it."""
        if self.value.lstrip().startswith("["):
            return [str(word) for word in json.loads(self.value)]
        return shlex.split(self.value)


@dataclass
class Stage:
    base: str
    name: str
    instructions: list[Instruction] = field(default_factory=list)

    def last(self, name: str) -> Instruction:
        """Return the last instruction of a name, which is the one that holds.

        Raises:
            LookupError: there is none.
        """
        for instruction in reversed(self.instructions):
            if instruction.name == name:
                return instruction
        raise LookupError(f"no {name}")

    def environment(self) -> dict[str, str]:
        """Return what a container's process gets: ENV, not ARG."""
        found: dict[str, str] = {}
        for instruction in self.instructions:
            if instruction.name == "ENV":
                found |= _pairs(instruction.value)
        return found


def read(file: Path) -> list[Stage]:
    """Return the stages of a Dockerfile.

    Raises:
        ValueError: an instruction before the first stage that is not ARG.
    """
    stages: list[Stage] = []
    everywhere: dict[str, str] = {}
    here: dict[str, str] = {}
    for name, text in _lines(file.read_text(encoding="utf-8")):
        known = here if stages else everywhere
        value = text if name == "RUN" else _filled(text, known)
        if name == "FROM":
            base, _, alias = _filled(text, everywhere).partition(" AS ")
            stages.append(Stage(base.strip(), alias.strip()))
            here = {}
            continue
        if name == "ARG":
            key, _, default = value.partition("=")
            known[key] = default or everywhere.get(key, "")
        elif name == "ENV":
            known |= _pairs(value)
        if stages:
            stages[-1].instructions.append(Instruction(name, value, dict(here)))
        elif name != "ARG":
            raise ValueError(f"{name} before the first FROM")
    return stages


def _lines(text: str) -> list[tuple[str, str]]:
    kept = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#"))
    joined = re.sub(r"\\\n", " ", kept)
    found = (line.strip().partition(" ") for line in joined.splitlines() if line.strip())
    return [(name.upper(), value.strip()) for name, _, value in found]


def _filled(text: str, values: dict[str, str]) -> str:
    return re.sub(r"\$\{?(\w+)\}?", lambda match: values.get(match[1], match[0]), text)


def _pairs(text: str) -> dict[str, str]:
    return dict(word.partition("=")[::2] for word in shlex.split(text))
