"""Who may enter the crossing, and when.

Conventions: metres, seconds. Distances are measured along each vehicle's own way, those to a stop line from its front
and those behind one from its rear; vehicles and pedestrians are numbered by their places in the simulation.
"""

from dataclasses import dataclass, field

from optipmb_client.datasets.scene.roads import MOVEMENTS, conflicts

_PATIENCE = 4.0
"""Seconds after which somebody who waits keeps others from entering before."""


@dataclass
class Crossing:
    """Who is on the crossing, and who waits to get onto it."""

    vehicles: dict[int, tuple[int, float]] = field(default_factory=dict)
    """Vehicle -> its movement and how far its rear is behind the stop line, for those with leave to cross."""
    waiting: dict[int, float] = field(default_factory=dict)
    """Vehicle -> seconds since it asked for leave, in the order of asking."""
    walkers: dict[int, int] = field(default_factory=dict)
    """Pedestrian -> the arm being crossed."""
    impatient: set[int] = field(default_factory=set)
    """Arms at which a pedestrian has waited long."""

    def ask(self, movements: dict[int, int], distance: dict[int, float], needed: dict[int, float]) -> None:
        """Let vehicles ask for leave.

        Only the first on its lane asks: leave for one behind would keep the one before it from ever getting leave.

        Args:
            movements: what each vehicle does at its next stop line.
            distance: of each vehicle to that line.
            needed: distance at which each must know whether it may go on.

        """
        lanes: set[tuple[str, int]] = set()
        for i in sorted(distance, key=distance.__getitem__):
            way = MOVEMENTS[movements[i]]
            if i in self.vehicles or (way.kind, way.start) in lanes:
                continue
            lanes.add((way.kind, way.start))
            if distance[i] < needed[i]:
                self.waiting.setdefault(i, 0.0)

    def grant(self, movements: dict[int, int], h: float) -> None:
        """Give leave to those who can go now, in the order of asking, and let h seconds pass for the others."""
        earlier: list[int] = []
        for i, waited in list(self.waiting.items()):
            movement = movements[i]
            if self._admits(movement, earlier):
                self.vehicles[i] = (movement, -float("inf"))
                del self.waiting[i]
            else:
                self.waiting[i] = waited + h
                if waited > _PATIENCE and not self._on_foot(movement):
                    earlier.append(movement)

    def wait_on_foot(self, arm: int, waited: float) -> bool:
        """Return whether somebody who waited so long may cross an arm now; the impatient hold up the traffic."""
        if not any(arm in (MOVEMENTS[m].start, MOVEMENTS[m].stop) for m, _ in self.vehicles.values()):
            return True
        if waited > _PATIENCE:
            self.impatient.add(arm)
        return False

    def _admits(self, movement: int, earlier: list[int]) -> bool:
        """Return whether a movement may begin, given those of others that have waited long already."""
        table = conflicts()
        if self._on_foot(movement) or any(table[other, movement] >= 0.0 for other in earlier):
            return False
        return not any(way < table[other, movement] for other, way in self.vehicles.values())

    def _on_foot(self, movement: int) -> bool:
        """Return whether a movement has to let pedestrians pass first."""
        way = MOVEMENTS[movement]
        return not {way.start, way.stop}.isdisjoint({*self.walkers.values(), *self.impatient})
