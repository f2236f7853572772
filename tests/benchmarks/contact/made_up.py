"""Results of the contact study that were made up, for tests of files and reports."""

from benchmarks.contact.data import CASES
from benchmarks.contact.result_files import PHASES, QUANTITIES, QUANTITY, ContactKey, ContactResult, ContactSettings
from benchmarks.contact.scores import SCORES

TINY = ContactSettings(
    num_inducing=15,
    first_iterations=30,
    num_samples=10,
    sample_spacing=1,
    num_particles=19,
    num_starts=3,
    num_paths=5,
)
"""A run takes a fraction of a second."""

OFFSETS = {
    (quantity, score): (QUANTITIES.index(quantity) - QUANTITIES.index(QUANTITY)) * (10.0 + SCORES.index(score))
    for quantity in QUANTITIES
    for score in SCORES
}
"""By quantity and score, all different but those of `QUANTITY`, which are zero."""


def made_up(key: ContactKey, value: float, after: float | None = None, starts_after: int = 1) -> ContactResult:
    """A run that has ``value`` for each score of each step, of 3 starts of which some are in contact from step 10 on.

    That is of `QUANTITY`; each score of the other quantities has `OFFSETS` added.

    Args:
        key: of the run.
        value: of the scores.
        after: of the scores of the steps from the contact on, if they are others.
        starts_after: starts that come into contact.
    """
    horizon = CASES[key.case].horizon
    in_contact = [0 if step < 9 else starts_after for step in range(horizon)]
    counts = {"before": [3 - n for n in in_contact], "after": in_contact}
    values = {"before": value, "after": value if after is None else after}
    scores = {
        quantity: {
            phase: {
                score: [values[phase] + OFFSETS[quantity, score] if n else None for n in counts[phase]]
                for score in SCORES
            }
            for phase in PHASES
        }
        for quantity in QUANTITIES
    }
    return ContactResult(
        key=key,
        settings=TINY,
        training_contact=0.9,
        test_contact=round(starts_after / 3, 6),
        scores=scores,
        counts=counts,
        paths=[[0.25 * path] * horizon for path in range(5)],
        truth=[0.2] * horizon,
        training={"iterations": 30.0},
        fit_seconds=1.5,
        test_seconds=0.5,
        facts={"revision": "unknown", "versions": {"python": "3"}, "machine": {"cores": 2}},
    )
