"""How large errors are beside what was stated of them."""

from dataclasses import dataclass

from l2m_gtsam.records.variance_shares import ErrorCause

FACTOR = 1.5  # a sigma that is stated to this is as good as one can ask
LEAST_GAIN = 11.0  # twice a logarithm; 0.1 % of right ones have more by chance (chi-square of one)


@dataclass(frozen=True)
class StatedSize:
    """Errors whose standard deviation was stated, and what the readings show of it.

    Attributes
    ----------
    cause
        Whose errors.
    ratio
        Standard deviation that the readings show over the one stated.
    gain
        Twice the logarithm by which the readings are more likely with it than as stated.
    sensor
        Which sensor's; all if none is named.
    """

    cause: ErrorCause
    ratio: float
    gain: float
    sensor: str | None = None

    @property
    def is_wrong(self) -> bool:
        """Whether what was stated is not what the readings show."""
        return self.gain > LEAST_GAIN and not 1 / FACTOR < self.ratio < FACTOR
