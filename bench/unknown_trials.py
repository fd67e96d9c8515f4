"""What was said of one draw of a world, and the table of how often it was right."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scipy.stats import binomtest


@dataclass(frozen=True)
class Trial:
    """One draw and what was said of it."""

    cell: str
    hidden: tuple[str, ...]
    verdict: str
    also: tuple[str, ...]  # what else is there: the errors of an ordinary arm
    named: tuple[str, ...]
    then: tuple[str, ...]  # named when asked again with what was named added
    group: tuple[str, ...]  # of which one is there at the end, if it ends so
    follows: str  # what is said to repeat without a name
    seconds: float
    certain: bool = True  # False where the name is said to be less than 20 to 1 over chance

    def __str__(self) -> str:
        hidden, named = ", ".join(self.hidden) or "nothing", " ".join((*self.named, *(f"then {n}" for n in self.then)))
        named += f" then one of {' '.join(self.group)}" if self.then and self.group else ""
        named += "" if self.certain else " (perhaps)"
        return f"{self.cell}: {hidden} → {self.verdict} {named}{self.follows} ({self.seconds:.1f} s)"

    @property
    def single(self) -> bool:
        """One name, right or wrong."""
        return self.verdict == "missing_effect"

    @property
    def alarm(self) -> bool:
        """A name or a group."""
        return bool(self.named)

    @property
    def joint(self) -> bool:
        """One joint is said to follow a law without a name."""
        return "above all" in self.follows

    @property
    def right_joint(self) -> bool:
        """And it is that one."""
        return self.joint and any(f"{name} " in self.follows for name in self.hidden)

    @property
    def right_course(self) -> bool:
        """What it follows is said: that joint, or several, or of what follows no joint the time."""
        if "joints" in self.hidden:
            return "joint" in self.follows
        follows_joint = any(name.startswith("joint ") for name in self.hidden)
        return self.right_joint if follows_joint else bool(self.follows) and "joint" not in self.follows

    @property
    def wrong(self) -> bool:
        """Nothing of what is named is there."""
        return not any(name in (*self.hidden, *self.also) for name in self.named)

    @property
    def right(self) -> bool:
        """What is hidden, or one of it, is named or in the group."""
        return any(name in self.hidden for name in self.named)

    @property
    def whole(self) -> bool:
        """All that is hidden is named in the end."""
        return bool(self.hidden) and set(self.hidden) <= {*self.named, *self.then}

    @property
    def whole_or_group(self) -> bool:
        """All that is hidden is named in the end, or the last of it in a group of which one is there."""
        left = set(self.hidden) - {*self.named, *self.then}
        return bool(self.hidden) and (not left or (len(left) == 1 and left <= set(self.group)))


_COLUMNS: dict[str, Callable[[Trial], bool]] = {
    "wrong name": lambda t: t.single and t.wrong,
    "wrong name said to be certain": lambda t: t.single and t.wrong and t.certain,
    "wrong group": lambda t: t.verdict == "cannot_tell" and t.wrong,
    "right name": lambda t: t.single and t.right,
    "right name said to be certain": lambda t: t.single and t.right and t.certain,
    "right name or group": lambda t: t.right,
    "all of it, asked again": lambda t: t.whole,
    "all of it, or the last in a group": lambda t: t.whole_or_group,
    "wrong when asked again": lambda t: any(name not in (*t.hidden, *t.also) for name in t.then),
    "unknown": lambda t: t.verdict == "unknown_effect",
    "adequate": lambda t: t.verdict == "adequate",
    "right joint above all": lambda t: t.right_joint,
    "wrong joint": lambda t: t.joint and not t.right_joint,
    "right joint or time": lambda t: t.right_course,
}
HEAD = "\n".join([f"| world | {' | '.join(_COLUMNS)} |", "|---" * (len(_COLUMNS) + 1) + "|"])


def shares(part: str, found: Sequence[Trial]) -> str:
    """A row of the table, every share with its 95 % Wilson interval."""
    told = [f"{share(found, hit)}" for hit in _COLUMNS.values()]
    return f"| {part} | {' | '.join(told)} |"


def share(found: Sequence[Trial], hit: Callable[[Trial], bool]) -> str:
    """k of n with its interval."""
    k = sum(hit(t) for t in found)
    low, high = binomtest(k, len(found)).proportion_ci(0.95, method="wilson")
    return f"{k}/{len(found)} [{low:.2f}, {high:.2f}]"
