"""A world that counts what it is asked for."""

from l2m_gtsam.data import FieldSample, FloatArray
from tests.worlds.exact import dipole_world


class Counting:
    """A world with a made-up variance that counts the places it is asked for."""

    def __init__(self) -> None:
        self.world, self.asked, self.fields = dipole_world(1), 0, 0

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        self.fields += len(points)
        return self.world.field_and_gradient(points)

    def query(self, points: FloatArray, /) -> FieldSample:
        self.asked += len(points)
        field, gradient = self.world.field_and_gradient(points)
        return FieldSample(field, gradient, points**2, points[:, 0] > 0)
