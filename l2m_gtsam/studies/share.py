"""How often something came true, and how sure that is."""

from dataclasses import dataclass

from l2m_gtsam.studies.statistics import wilson_interval


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
        band = wilson_interval(self.rate, self.trials)
        return band.low, band.high
