"""How often something came true, and how sure that is."""

from dataclasses import dataclass

from scipy.stats import binomtest

LEVEL = 0.95


@dataclass(frozen=True)
class Share:
    """A number of successes among independent trials."""

    successes: int
    trials: int

    @property
    def rate(self) -> float:
        """Successes per trial."""
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the probability."""
        found = binomtest(self.successes, self.trials).proportion_ci(LEVEL, method="wilson")
        return float(found.low), float(found.high)
