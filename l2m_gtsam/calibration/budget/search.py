"""Which processes a drive has, and how large: by the likelihood of what all else leaves."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress

import numpy as np

from l2m_gtsam.calibration.budget.processes import Process
from l2m_gtsam.calibration.joint_information import JointInformation, Rows
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.records.error_budget import DisturbanceKind
from l2m_gtsam.solve.chi_square import chance_beyond
from l2m_gtsam.solve.variance_components import (
    TO_THE_TOP,
    VarianceComponents,
    WeightSystem,
    shared_components,
)

# Twice a logarithm of likelihood. Of processes that are not there 0.7 % have more; and of what is
# found, so much may be there by chance.
LEAST_GAIN, BY_CHANCE = 6.0, 0.05
NO_WEIGHTS = np.empty(0, dtype=np.int64)
BATCH = 4000  # readings whose processes are held at once: 30 MB
HARDLY = 1.5  # standard deviations of a score: no more is not worth a likelihood


@dataclass(frozen=True)
class FoundProcess:
    """A process with the sizes that explain the drive best.

    Attributes
    ----------
    process
        Its modes.
    form
        Which of its forms.
    sizes
        Variances of the parts of that form, shape (K,).
    gain
        Twice the logarithm of the likelihood beyond that without it, less the price of having had
        the choice of several forms.
    """

    process: Process
    form: int
    sizes: FloatArray
    gain: float

    @cached_property
    def variances(self) -> FloatArray:
        """Of its weights, shape (m,)."""
        return np.asarray(self.sizes @ self.process.forms[self.form])


@dataclass(frozen=True)
class Searched:
    """The processes that were found, and where the graph's optimum is with them.

    Attributes
    ----------
    found
        The processes.
    noise
        Share of the noise's variance that they leave.
    weights
        The most likely weights of each in units of their sigmas, shapes (m,).
    moved
        How far these move all n variables of the graph that has none of them, shape (n,).
    """

    found: tuple[FoundProcess, ...] = ()
    noise: float = 1.0
    weights: tuple[FloatArray, ...] = ()
    moved: FloatArray = field(default_factory=lambda: np.empty(0))


NOTHING_SEARCHED = Searched()


@dataclass(frozen=True)
class ProcessInformation:
    """What white readings say of the weights of several processes.

    Attributes
    ----------
    processes
        Each with its columns.
    columns
        Of each among all weights, shape (m,).
    system
        All weights together, with everything else taken out.
    squares
        Sum of squares of the white residuals.
    joint, across
        All n variables of the graph, and their information with the weights, shape (n, M).
    """

    processes: Sequence[Process]
    columns: Sequence[IntArray]
    system: WeightSystem
    squares: float
    joint: JointInformation
    across: FloatArray

    @property
    def influence(self) -> FloatArray:
        """By how much a unit of each weight is off all variables of the graph, shape (n, M)."""
        return self._moved(self.across)

    def of_kind(self, kind: DisturbanceKind) -> "ProcessInformation":
        """Return the same of the processes of one kind alone."""
        own = [k for k, each in enumerate(self.processes) if each.kind is kind]
        at = np.concatenate([NO_WEIGHTS, *(self.columns[k] for k in own)])
        ends = np.cumsum([len(self.columns[k]) for k in own])
        return replace(
            self,
            processes=[self.processes[k] for k in own],
            columns=np.split(np.arange(len(at)), ends[:-1]),
            system=self.system.among(at),
            across=self.across[:, at],
        )

    def searched(self, found: Sequence[FoundProcess], noise: float) -> Searched:
        """Return processes with the weights that are most likely beside so much of the noise."""
        own = [self.columns[self.processes.index(each.process)] for each in found]
        at = np.concatenate([NO_WEIGHTS, *own])
        root = np.sqrt(np.concatenate([np.empty(0), *(each.variances for each in found)]))
        fit = self.system.among(at).whiter(noise).fit(root**2)
        white = root * fit.rest
        # Weights take degrees of freedom; white squares are as many as there were.
        noise *= self.squares / (self.squares - float(fit.share.sum()))
        pull = self.across[:, at] @ (root * white)
        moved = self._moved(pull[:, None])[:, 0]
        ends = np.cumsum([len(each) for each in own])[:-1]
        return Searched(tuple(found), noise, tuple(np.split(white, ends)), moved)

    def _moved(self, pull: FloatArray) -> FloatArray:
        """Return where pulls, shape (n, k), take all variables, in the system itself."""
        loose = self.joint.loose
        return np.asarray(loose @ (loose.T @ pull) - self.joint.every @ pull)


def process_information(
    processes: Sequence[Process],
    joint: JointInformation,
    rows: Sequence[Rows],
    whitened: Sequence[FloatArray],
    C: FloatArray,
) -> ProcessInformation:
    """Return what readings say of processes that are not in their graph.

    Parameters
    ----------
    processes
        What is looked for.
    joint
        All variables of the graph.
    rows
        White rows of readings at the optimum, one set for each group.
    whitened
        Of each group the matrix or matrices that make it white, (n, 3, 3) or (3 n, 3 n).
    C
        Of all readings, shape (N, 3, 3).
    """
    ends = np.cumsum([0, *(each.forms[0].shape[1] for each in processes)])
    columns = [np.arange(ends[k], ends[k + 1]) for k in range(len(processes))]
    count = int(ends[-1])
    own, pull = np.zeros((count, count)), np.zeros(count)
    across = np.zeros((len(joint.every), count))
    # One product for many groups of a sensor: sums of one for each group are mostly indexing.
    for groups in batches(rows, whitened):
        sensor = groups[0][0].sensor
        here = [k for k, one in enumerate(processes) if one.sensor in (None, sensor)]
        at = np.concatenate([columns[k] for k in here])
        readings = np.concatenate([each.readings for each, _ in groups])
        F = np.concatenate([processes[k].features(readings) for k in here], axis=2)
        Z, first = (C[readings] @ F).reshape(3 * len(readings), -1), 0
        part = np.zeros((len(across), len(at)))  # whole rows of it are added to: they lie together
        for each, W in groups:
            white = slice(first, first + len(each.residual))
            Z[white] = _times(W, Z[white])
            part[each.columns] += each.jacobian.T @ Z[white]
            first = white.stop
        across[:, at] += part
        own[np.ix_(at, at)] += Z.T @ Z
        pull[at] -= Z.T @ np.concatenate([each.residual for each, _ in groups])
    # The residuals are those of the system itself, which holds the survey's sensors tighter.
    loose = joint.loose.T @ across
    information = own - across.T @ joint.every @ across + loose.T @ loose
    system = WeightSystem(0.5 * (information + information.T), pull)
    squares = sum(float(each.residual @ each.residual) for each in rows)
    return ProcessInformation(processes, columns, system, squares, joint, across)


def batches(
    rows: Sequence[Rows], whitened: Sequence[FloatArray]
) -> Iterator[list[tuple[Rows, FloatArray]]]:
    """Return groups of one sensor each with what makes them white, up to so many readings."""
    pairs = sorted(zip(rows, whitened, strict=True), key=lambda pair: pair[0].sensor)
    batch: list[tuple[Rows, FloatArray]] = []
    count = 0
    for each, W in pairs:
        if batch and (each.sensor != batch[0][0].sensor or count > BATCH):
            yield batch
            batch, count = [], 0
        batch.append((each, W))
        count += len(each.readings)
    if batch:
        yield batch


def _times(W: FloatArray, Z: FloatArray) -> FloatArray:
    """Return W Z, shape (3 n, m), with a matrix for each of n readings or one for all."""
    if W.ndim == 2:
        return W @ Z
    return np.asarray((W @ Z.reshape(len(W), 3, -1)).reshape(Z.shape))


def search(known: ProcessInformation) -> Searched:
    """Return the processes without which a drive is much less likely.

    The kind that explains most is taken first, for all sensors that show it; the others have to
    explain what it leaves. In the end all sizes are found together.
    """
    taken: dict[int, FoundProcess] = {}
    variances = np.zeros(len(known.system.pull))
    kinds = set(DisturbanceKind)
    while kinds:
        left = known.system.beside(variances)
        alone = {
            k: _alone(each, left.among(known.columns[k]))
            for k, each in enumerate(known.processes)
            if each.kind in kinds
        }
        gains_alone = np.array([found.gain for found in alone.values()])
        worth = credible(gains_alone, len(known.processes))
        shown = dict(compress(alone.items(), worth))
        if not shown:
            break
        gains = {kind: _gain(shown, kind) for kind in kinds}
        first = max(kinds, key=lambda kind: (gains[kind], kind))
        kinds.remove(first)
        for k, found in shown.items():
            if found.process.kind is first:
                taken[k] = found
                variances[known.columns[k]] = found.variances
    return _together(known, taken)


def credible(gains: FloatArray, looked_for: int) -> BoolArray:
    """Return which of the best processes are more than the luck of having looked for many.

    Of what is kept, a share of ``BY_CHANCE`` at most is not there (Benjamini and Hochberg, JRSS B
    57, 1995): one process in many has to gain more than several that are seen together. None is
    kept that does not gain ``LEAST_GAIN``.

    Parameters
    ----------
    gains
        Twice the logarithms of their likelihoods, shape (K,).
    looked_for
        How many processes there were to choose from, K or more.
    """
    # Where a process is not there, half of all drives give zero, and the others a chi-square of
    # one (Self and Liang, JASA 82, 1987): the parts of a process are too alike for more.
    chance = 0.5 * chance_beyond(gains, 1)
    order = np.argsort(chance)
    rank = np.arange(1, len(order) + 1)
    below = np.flatnonzero(chance[order] <= BY_CHANCE * rank / looked_for)
    worth = np.zeros(len(order), dtype=bool)
    worth[order[: below[-1] + 1 if len(below) else 0]] = True
    return worth & (gains > LEAST_GAIN)


def _gain(found: dict[int, FoundProcess], kind: DisturbanceKind) -> float:
    return sum(each.gain for each in found.values() if each.process.kind is kind)


def _alone(process: Process, system: WeightSystem) -> FoundProcess:
    """Return a process in its most likely form, beside what a system leaves."""
    fits = [
        system.components(spectra)
        if system.scores(spectra).max() > HARDLY
        else VarianceComponents(np.zeros(len(spectra)), 0.0)
        for spectra in process.forms
    ]
    form = int(np.argmax([fit.gain for fit in fits]))
    return FoundProcess(process, form, fits[form].sizes, fits[form].gain - _price(process))


def _price(process: Process) -> float:
    """Return what the best of several forms has to gain, twice a logarithm: each is as likely."""
    return 2 * float(np.log(len(process.forms)))


def _together(known: ProcessInformation, taken: dict[int, FoundProcess]) -> Searched:
    """Return processes with the sizes that are most likely for all of them at once."""
    if not taken:
        return NOTHING_SEARCHED
    spectra, owner = [], []
    for k, found in taken.items():
        for part in found.process.forms[found.form]:
            whole = np.zeros(len(known.system.pull))
            whole[known.columns[k]] = part
            spectra.append(whole)
            owner.append(k)
    of, every = np.array(owner), np.array(spectra)
    at = np.flatnonzero(every.any(axis=0))
    every = every[:, at]
    system = known.system.among(at)
    alone = np.concatenate([found.sizes for found in taken.values()])
    fit = shared_components([system], [every], known.squares, TO_THE_TOP, alone)
    system = system.whiter(fit.noise)
    likely = []
    for k, each in taken.items():
        others = np.where(of == k, 0.0, fit.sizes) @ every
        own = known.columns[k]
        here = np.searchsorted(at, own)
        left = system.left_to(others, here)
        sizes = fit.sizes[of == k]
        gain = 2 * left.fit(sizes @ each.process.forms[each.form]).likelihood
        likely.append(FoundProcess(each.process, each.form, sizes, gain - _price(each.process)))
    worth = credible(np.array([each.gain for each in likely]), len(known.processes))
    kept = list(compress(likely, worth))
    return known.searched(kept, fit.noise) if kept else NOTHING_SEARCHED
