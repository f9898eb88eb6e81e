"""Which numbers of a recording could explain what the field of a place does not."""

from typing import Annotated

from pydantic import Field, field_validator

from l2m_gtsam.options import Options

STEP = r"[A-Za-z][A-Za-z0-9_]{0,99}(\[[0-9]{1,6}\])?"
PATH = rf"^{STEP}(\.{STEP}){{0,19}}$"

RegressorName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,99}$")]
"""Letters, digits and underscores, a letter first."""


class RegressorTopic(Options):
    """Where a number is found that goes along with a drive."""

    topic: str = Field(min_length=1)
    """Topic of any type; the leading slash does not matter."""
    field: str = Field(default="data", pattern=PATH)
    """Where the number stands in a message: names with dots between, an element of an array with
    its index, for example `current`, `twist.twist.linear.x` or `data[2]`."""
    scale: float = 1.0
    """Factor on the number; coefficients are in microtesla per unit of the product."""

    @field_validator("scale")
    @classmethod
    def _not_nothing(cls, scale: float) -> float:
        if scale == 0:
            raise ValueError("a scale of 0 leaves nothing of the number")
        return scale
