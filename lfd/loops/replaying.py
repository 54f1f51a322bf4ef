"""What `lfd replay` shows of what loops make: scenes around plans and corrections, the two sides of a question."""

from dataclasses import replace
from pathlib import Path

from lfd.core.episode import EpisodeMetadata
from lfd.core.errors import InputError
from lfd.loops.comparing import Answer, Comparison
from lfd.loops.comparison_folder import STATE, resumed
from lfd.loops.comparison_pictures import pair_clips
from lfd.loops.cup_scenes import Placement
from lfd.planning.arm_model import load_arm
from lfd.planning.signed_distances import Shape
from lfd.replay.clip import Clip
from lfd.replay.listing import Entry, Listing, listing_of

SCENE = "scene"
"""Table of a recording's recipe that holds a placement."""
SAID = {"a": ("preferred", "not preferred"), "b": ("not preferred", "preferred"), "equal": ("about equal",) * 2}
"""What an answer says of A and of B."""


def listing(source: Path, round_number: int | None = None) -> Listing:
    """What there is to be seen at a path, whatever made it.

    Raises `InputError` when there is nothing, with a word on what to type.
    """
    if (source / STATE).is_file() and round_number is None:
        return _of_comparison(source)
    return listing_of(source, round_number, scene_shapes)


def scene_shapes(told: EpisodeMetadata) -> tuple[Shape, ...]:
    """What stands in the scene of a plan or a correction: person, laptop, pedestal."""
    if SCENE not in told.recipe:
        return ()
    return tuple(Placement.of(told.recipe[SCENE], f"[{SCENE}] of the recording").scene(load_arm(told.robot)).shapes)


def _of_comparison(source: Path) -> Listing:
    """The questions of a comparison that were answered, each with its two sides."""
    comparison = resumed(source).comparison
    if not comparison.answers:
        raise InputError(f"no question of {source} was answered yet; lfd compare POOL --out {source} --resume asks")

    def entry(answer: Answer) -> Entry:
        number = answer.question.number
        said = {"a": "A preferred", "b": "B preferred", "equal": "about equal"}[answer.choice]
        title = f"question {number + 1}: {said}"
        return Entry(title, lambda: _pair(comparison, answer), lambda: None)

    return Listing(source, "comparison", tuple(entry(answer) for answer in comparison.answers))


def _pair(comparison: Comparison, answer: Answer) -> tuple[Clip, ...]:
    """A and B, with what was said of each and the weights that followed."""
    number, names = answer.question.number, comparison.begin.features
    before, after = (comparison.belief(count).mode * comparison.begin.ranges for count in (number, number + 1))
    weights = {f"weight x range of {n}": f"{x:.3g} -> {y:.3g}" for n, x, y in zip(names, before, after, strict=True)}
    asked = {"question": f"{number + 1}, expected to tell {answer.question.bits:.2f} bits", **weights}
    pair = zip(pair_clips(comparison.pool, answer.question), SAID[answer.choice], strict=True)
    return tuple(replace(clip, title=f"{clip.title}, {said}", about={**clip.about, **asked}) for clip, said in pair)
