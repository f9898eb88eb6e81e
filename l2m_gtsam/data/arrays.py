"""Types of arrays, and how pydantic reads them in a file."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
FieldAndGradient = tuple[FloatArray, FloatArray]  # (N, 3) in uT and (N, 3, 3) in uT/m


@dataclass(frozen=True)
class InFile:
    """How pydantic reads an array in a file; it is written as nested lists.

    Attributes
    ----------
    type
        Type of the plain values: nested tuples of numbers, which fix the shape.
    array
        Makes the array of them.
    """

    type: Any
    array: Callable[[Any], FloatArray] = np.array

    def __get_pydantic_core_schema__(
        self, _source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            self.array,
            handler.generate_schema(self.type),
            serialization=core_schema.plain_serializer_function_ser_schema(np.ndarray.tolist),
        )


Row3 = tuple[float, float, float]
Vector = Annotated[FloatArray, InFile(Row3)]
"""Shape (3,)."""
Matrix = Annotated[FloatArray, InFile(tuple[Row3, Row3, Row3])]
"""Shape (3, 3)."""
