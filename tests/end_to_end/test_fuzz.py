"""Files changed at random: a short run for the gate, a long one for `make study`."""

import os
from pathlib import Path

import pytest

from l2m_gtsam.storage.cloud import read_cloud
from tests.fuzz.cases import Case, case_of, ended
from tests.fuzz.corpus import make_demo, quick_corpus, whole_corpus
from tests.fuzz.run import FILES, run
from tests.fuzz.runner import BAD, GOOD, run_case
from tests.fuzz.sound import CASE, Sound

EACH = 1  # cases of each file in the short run; thousands in the long one
LONG = "L2M_FUZZ_CASES"  # environment variable: how many cases of the long run


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> list[Sound]:
    return quick_corpus(tmp_path_factory.mktemp("corpus"), FILES.resolve())


def test_sound_files_are_read(corpus: list[Sound]) -> None:
    """Else their changes would all be refused for one reason."""
    run_already = set[object]()
    for number, sound in enumerate(corpus):
        # Of exports one: which formats a calibration can be written in is tested elsewhere.
        for words in sound.commands if sound.commands[0][0] == "inspect" else sound.commands[:1]:
            # Files of one folder are sound files each, and one input of one command.
            same = words, frozenset((sound.path, *sound.beside)) if CASE not in words else number
            if same in run_already:
                continue
            run_already.add(same)
            found = ended(Case(number, sound, "none", words, sound.path.read_bytes()))
            assert found.how == GOOD[0], (sound.kind, words, found)


def test_threads_of_other_tests_do_no_harm(corpus: list[Sound], tmp_path: Path) -> None:
    """A compressed cloud that was read here starts threads, which a command has none of."""
    sound = next(each for each in corpus if each.path.suffix == ".laz")
    read_cloud(sound.path, 0.1)
    assert run_case(["read", "cloud", str(sound.path)], tmp_path, tmp_path / "out").how == GOOD[0]


def test_a_case_is_the_same_each_time(corpus: list[Sound]) -> None:
    for number in range(len(corpus)):
        assert case_of(corpus, number) == case_of(corpus, number)


def test_nothing_breaks_it(corpus: list[Sound], tmp_path: Path) -> None:
    counts, _ = run(range(EACH * len(corpus)), corpus, tmp_path)
    found = {how for _, how in counts}
    assert not found & set(BAD), (tmp_path / "table.md").read_text()
    assert found >= {GOOD[0], GOOD[2]}


@pytest.mark.study
def test_nothing_breaks_it_for_long(tmp_path: Path) -> None:
    demo = tmp_path / "demo"
    make_demo(demo)
    folder = tmp_path / "corpus"
    folder.mkdir()
    whole = whole_corpus(folder, FILES.resolve(), demo)
    counts, took = run(range(int(os.environ.get(LONG, "10000"))), whole, tmp_path)
    print(took, (tmp_path / "table.md").read_text(), sep="\n")
    assert not {how for _, how in counts} & set(BAD)
