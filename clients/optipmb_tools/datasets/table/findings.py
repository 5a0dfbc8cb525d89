"""Findings about a table: assumptions, doubts and errors, with the evidence and the option that corrects each.

An option of the user holds, then what the name of a column says, then the first way to read the values, unless another
way has the stronger evidence (`Evidence.beats`), or the values rule it out. `Reading.decide` alone compares evidence.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from optipmb_tools.datasets.evidence import Evidence
from optipmb_tools.datasets.interface import Assumption
from optipmb_tools.files import DatasetError, is_number
from optipmb_tools.table_files import line_of

NOISE: Final = 0.1  # difference of two shares that tells nothing
HALF: Final = 0.5  # share of its rival's evidence up to which a reading is refused


@dataclass(frozen=True)
class Finding:
    """An assumption about a recording, or an error in it."""

    topic: str  # subject: `time`, `yaw`, `scores` …
    text: str  # one line
    option: str = ""  # that changes it
    wrong: bool = False  # whether `optipmb track` refuses the recording for it
    doubt: bool = False  # whether the tracks may be wrong for it
    evidence: Evidence = field(default_factory=Evidence)


@dataclass(frozen=True)
class Claim:
    """One way to read values, and how many of them agree with it."""

    value: str  # of the option that chooses it
    evidence: Evidence = field(default_factory=Evidence)
    text: str = ""
    option: str = ""
    wins: Literal["taken", "doubt", "refused"] = "taken"  # what happens to the table where it has the best evidence
    sure: bool = True  # whether there is enough evidence to refuse by
    possible: bool = True  # whether the values can have this meaning
    least: float = 0.0  # share of the evidence below which it is doubted, also without a rival

    def beats(self, other: "Claim") -> bool:
        """Tell whether this is the better way: the only possible one, or that with the stronger evidence."""
        return self.possible and (not other.possible or self.evidence.beats(other.evidence))


@dataclass(frozen=True)
class Understood:
    """Column of a table that is read, or is not."""

    role: str  # meaning; empty: it is not used
    column: str
    unit: str  # in its name
    example: str  # of the first row


@dataclass
class Reading:
    """Files of a recording, options of the user, and findings.

    Attributes:
        path: The file, or the folder of several.
        options: Options of the data set.
        lenient: Errors become findings; the reader goes on as if nothing were known.
        files: Each file with the first of its rows; empty: all rows are in `path`.
        understood: Columns that were found, for people.
        named: Options `column.*` and `class.*`, with the error if they name nothing in the tables read so far.
    """

    path: Path
    options: Mapping[str, str]
    lenient: bool = False
    files: tuple[tuple[Path, int], ...] = ()
    findings: list[Finding] = field(default_factory=list)
    understood: list[Understood] = field(default_factory=list)
    named: dict[str, DatasetError | None] = field(default_factory=dict)

    @property
    def skips(self) -> bool:
        """Whether the user leaves out rows that cannot be used."""
        return self.chosen("invalid", ("skip", "refuse")) == "skip"

    @property
    def marks(self) -> list[float]:
        """Numbers by which the user says that a cell has no value.

        Raises:
            DatasetError: One of them is no number.
        """
        texts = [text.strip() for text in self.options.get("missing", "").split(",") if text.strip()]
        if wrong := [text for text in texts if not is_number(text)]:
            raise DatasetError("--option missing", "numbers, with commas between them", repr(wrong[0]))
        return [float(text) for text in texts]

    @property
    def notes(self) -> list[str]:
        """The findings, a line each, behind the path."""
        lines = [f"{one.text} ({one.option})" if one.option else one.text for one in self.findings]
        kinds = [str if one.doubt or one.wrong else Assumption for one in self.findings]
        return [kind(f"{self.path}: {line}") for kind, line in zip(kinds, lines, strict=True)]

    def add(self, finding: Finding) -> None:
        """Report a finding, once."""
        if finding not in self.findings:
            self.findings.append(finding)

    def note(self, topic: str, text: str, option: str = "") -> None:
        """Report an assumption."""
        self.add(Finding(topic, text, option))

    def doubt(self, topic: str, text: str, option: str = "") -> None:
        """Report that tracks may be wrong."""
        self.add(Finding(topic, text, option, doubt=True))

    def refuse(self, topic: str, expected: str, received: str, option: str = "", row: int | None = None) -> None:
        """Raise a `DatasetError`; with `lenient`, add a finding."""
        path, line = (self.path, None) if row is None else self.place(row)
        if not self.lenient:
            raise DatasetError(path, f"{expected} ({option})" if option else expected, received, line=line)
        where = "" if line is None else f"{path.name}:{line}: "
        self.add(Finding(topic, f"{where}expected {expected}, received {received}", option, wrong=True))

    def decide(
        self,
        topic: str,
        claims: Sequence[Claim],
        things: str = "",
        *,
        clash: str = "",
        expected: str = "",
        received: str = "",
        asked: str | None = None,
    ) -> str:
        """Return the value of the claim that holds; report it, or a rival that beats it.

        Args:
            topic: Of the findings.
            claims: The first one holds unless another one beats it.
            things: Noun and verb behind a share, as in "moves are along it"; empty: shares are not shown.
            clash: Text of the doubt where the evidence contradicts the claim that holds.
            expected: For the error.
            received: For the error where not exactly one claim is possible, and the user has to choose.
            asked: Value that the user has chosen.
        """
        rival = max(claims, key=lambda one: (one.possible, one.evidence.share))
        held = next((one for one in claims if one.value == asked), claims[0])
        if asked is None and rival.wins == "taken" and rival.beats(held):
            held = rival
        mine, other = held.evidence, rival.evidence
        disputed = rival.beats(held) and (held.possible or asked is None)
        parts = [f"{mine.share:.0%} of {mine.of:.0f} {things}"] if things and mine.of else []
        if disputed:
            parts.append(f"{other.share:.0%} {rival.text}" if things else rival.text)
        counted = ", ".join(parts)
        weak = mine.share < HALF * other.share or not held.possible
        if asked is None and received and sum(one.possible for one in claims) != 1:
            self.refuse(topic, expected, received, held.option)
        elif disputed and asked is None and rival.wins == "refused" and rival.sure and weak:
            self.refuse(topic, expected, counted, rival.option)
        elif disputed or mine.bounds[1] < held.least:
            text = f"{clash}: {counted}" if clash else counted
            self.add(Finding(topic, text, rival.option if disputed else held.option, doubt=True, evidence=other))
        elif held.text:
            text = ": ".join(part for part in (held.text, counted) if part)
            self.add(Finding(topic, text, "" if asked else held.option, evidence=mine))
        return held.value

    def name(self, option: str, known: Collection[str], expected: str, name: str) -> None:
        """Record whether a table has the column or class that an option names."""
        error = DatasetError(f"--option {option}", f"{expected}: {', '.join(known)}", repr(name))
        if name in known or name.lower() in map(str.lower, known):
            self.named[option] = None
        self.named.setdefault(option, error)

    def place(self, row: int) -> tuple[Path, int]:
        """Return the file of a row and its line there, counted from 1."""
        path, first = next((one for one in reversed(self.files) if one[1] <= row), (self.path, 0))
        return path, line_of(path, row - first, self.options)

    def chosen(self, name: str, known: Mapping[str, object] | tuple[str, ...]) -> str | None:
        """Return the value of an option; None where it is not given.

        Raises:
            DatasetError: It is not one of `known`.
        """
        value = self.options.get(name)
        if value is not None and value not in known:
            raise DatasetError(f"--option {name}", " or ".join(known), repr(value))
        return value

    def positive(self, name: str, what: str, *, zero: bool = False) -> float | None:
        """Return the value of an option that is a positive number; None where it is not given."""
        text = self.options.get(name)
        if text is None:
            return None
        if not is_number(text) or not (0.0 < float(text) < float("inf") or (zero and float(text) == 0.0)):
            raise DatasetError(f"--option {name}", f"{what}, a positive number", repr(text))
        return float(text)

    def strict(self) -> "Reading":
        """Return this one, whose errors are raised: for what nothing can be found without."""
        return replace(self, lenient=False)

    def first(self, topic: str, bad: np.ndarray, expected: str, values: np.ndarray, option: str = "") -> None:
        """Refuse the first row that is `bad`."""
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            value = values[row]
            shown = repr(value.item()) if isinstance(value, np.str_) else str(value)
            self.refuse(topic, expected, shown, option, row)
