import pytest

from lfd.bench.dagger import BC, NOISY, SCRATCH, WARM, DaggerBench, Point, plot, rows_of, setting_of
from lfd.core.errors import UnknownName


def points(*marks: tuple[int, list[int]]) -> list[list[Point]]:
    return [[Point(labels=n, successes=each, gradient_steps=n, seconds=1.0) for each in won] for n, won in marks]


MEASURED = DaggerBench(
    task="Lift",
    episodes=10,
    seeds=(0, 1),
    points={
        BC: points((100, [0, 2]), (300, [5, 7]), (500, [9, 9])),
        NOISY: points((110, [9, 9]), (310, [8, 8]), (510, [10, 10])),  # it must stay there
        SCRATCH: points((100, [0, 2]), (300, [9, 9]), (500, [10, 10])),
        WARM: points((100, [0, 2]), (300, [8, 9]), (500, [10, 10])),
    },
)


def test_success_is_that_of_all_seeds_and_labels_are_the_fewest_that_suffice_from_there_on() -> None:
    rows = rows_of(MEASURED)
    assert "DAgger 90.0% [69.9%, 97.2%], seeds 90% to 90%" in rows["about 300 labels"]  # Wilson, 18 of 20
    assert rows["labels for 90% success over all seeds"] == (
        "BC 500, BC, noisy expert 510, DAgger 300, DAgger, warm 500"
    )
    assert rows["labels for 99% success over all seeds"].startswith("BC more than 500, ")
    assert rows["retraining, DAgger, warm"].startswith("500 gradient steps, 1.0 s, success 100.0%")


def test_the_curves_are_drawn(tmp_path) -> None:
    plot(MEASURED, tmp_path / "labels.png")
    assert (tmp_path / "labels.png").stat().st_size > 0


def test_learners_of_a_seed_share_everything_but_the_noise_and_the_rounds() -> None:
    setting = setting_of("Lift", quick=False)
    clean, noisy = setting.recipes(3), setting.recipes(3, noise=setting.noise)
    assert (clean.record.seed, clean.train.seed, clean.tried.seed, clean.dagger.seed) == (3, 3, 3, 3)
    assert (clean.record.action_noise, noisy.record.action_noise) == (0.0, 0.2)
    assert clean.train == noisy.train
    assert clean.dagger.rounds == setting.marks[-1] + 1
    with pytest.raises(UnknownName, match="known: Lift"):
        setting_of("Wipe", quick=True)
