"""A hypothesis about a log, beside the simple physics that any machine may lack."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_h2o.data.audit.finding import Finding
from torchrl_h2o.data.audit.physics import BETTER, Explained
from torchrl_h2o.data.audit.response import Response


@dataclass(frozen=True, eq=False)
class Rival:
    """A hypothesis and what it explains.

    Args:
        explained: what it explains.
        plain: what simple physics explains of the same windows.
        findings: what to say if it is the best.
        response: the windows with a simulator under which others are to be compared; None for a fault of the columns.
        enough: share of what is left of one velocity at least that it leaves at most; 1 if evidence is enough.
    """

    explained: Explained
    plain: Explained
    findings: tuple[Finding, ...]
    response: Response | None = None
    enough: float = BETTER

    @property
    def is_better(self) -> bool:
        """Whether it explains much more."""
        return self.explained.explains_more(self.plain, self.enough)

    @property
    def leaves(self) -> float:
        """Share of what simple physics leaves that it leaves."""
        return self.explained.share / max(self.plain.share, 1e-12)


def leaves(plain: Explained, explained: Explained) -> str:
    """What two explanations leave, in words that a condition follows."""
    shares = percent(plain.share), percent(explained.share)
    return f"the simulator leaves {shares[0]} of the accelerations unexplained, and {shares[1]} if "


def percent(share: float) -> str:
    """A share in words."""
    return "all" if share >= 0.995 else f"{share:.0%}"
