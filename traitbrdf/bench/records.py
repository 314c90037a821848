"""Figures with their targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

Say = Callable[[str], None]


@dataclass(frozen=True)
class Record:
    """One figure. `target` and `met` are None where none is set; `error` belongs to a time."""

    name: str
    value: float
    unit: str
    target: float | None = None
    met: bool | None = None
    error: float | None = None
    how: str = ""

    @classmethod
    def at_most(cls, name: str, value: float, unit: str, target: float, **more: Any) -> Record:
        return cls(name, value, unit, target, bool(value <= target), **more)

    @classmethod
    def at_least(cls, name: str, value: float, unit: str, target: float, **more: Any) -> Record:
        return cls(name, value, unit, target, bool(value >= target), **more)

    def line(self) -> str:
        """One line of a table."""
        goal = "" if self.target is None else f"  (target {self.target:g}, "
        goal += "" if self.target is None else ("met)" if self.met else "MISSED)")
        error = "" if self.error is None else f"  at frame error {100 * self.error:.3f} %"
        return f"{self.name:44s} {self.value:10.4g} {self.unit:6s}{error}{goal}  [{self.how}]"

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


NAMES = (
    "transport", "families", "shadows", "table", "embedding", "edit", "prepare", "peers", "traits",
    "promises", "trade",
)  # fmt: skip
"""Benches; `traitbrdf.bench.run` has what each measures."""

ON_REQUEST = frozenset({"peers", "promises", "trade"})
"""Benches that run only where they are named: they take long, or need what the package does
without."""
