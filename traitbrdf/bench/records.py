"""Measured figures with their targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

Say = Callable[[str], None]


@dataclass(frozen=True)
class Record:
    """One measured figure.

    Parameters
    ----------
    name : str
    value : float
    unit : str
    target : float or None
        The value to reach, if there is one.
    met : bool or None
        Whether it was reached.
    error : float or None
        Frame error at which a time was measured.
    how : str
        The conditions of the measurement.
    """

    name: str
    value: float
    unit: str
    target: float | None = None
    met: bool | None = None
    error: float | None = None
    how: str = ""

    @classmethod
    def at_most(cls, name: str, value: float, unit: str, target: float, **more: Any) -> Record:
        """Return a record that meets its target if `value` is at most `target`.

        Parameters
        ----------
        name, unit : str
        value, target : float
        **more
            Other fields of `Record`.
        """
        return cls(name, value, unit, target, bool(value <= target), **more)

    @classmethod
    def at_least(cls, name: str, value: float, unit: str, target: float, **more: Any) -> Record:
        """Return a record that meets its target if `value` is at least `target`.

        Parameters
        ----------
        name, unit : str
        value, target : float
        **more
            Other fields of `Record`.
        """
        return cls(name, value, unit, target, bool(value >= target), **more)

    def line(self) -> str:
        """Return the record as one line of a table."""
        goal = "" if self.target is None else f"  (target {self.target:g}, "
        goal += "" if self.target is None else ("met)" if self.met else "MISSED)")
        error = "" if self.error is None else f"  at frame error {100 * self.error:.3f} %"
        return f"{self.name:44s} {self.value:10.4g} {self.unit:6s}{error}{goal}  [{self.how}]"

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)


NAMES = (
    "transport", "families", "shadows", "table", "embedding", "edit", "prepare", "live", "peers",
    "traits", "local", "export", "promises", "trade",
)  # fmt: skip
"""Names of the benches; `traitbrdf.bench.run` maps them to functions."""

ON_REQUEST = frozenset({"peers", "export", "promises", "trade"})
"""Benches that run only when named: they take long, or need optional packages."""
