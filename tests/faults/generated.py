"""Thousands of generated examples, counted by what came out of each; for `cases.py` and `outcomes.py`."""

import collections
import warnings

import torch
from hypothesis import HealthCheck, Phase, given, settings


def count_outcomes(examples, outcome, number):
    """({outcome: count}, the smallest example found that went wrong, as texts).

    Args:
        examples: a strategy of hypothesis.
        outcome: a word for what came out of an example; raises where that is wrong.
        number: of examples.
    """
    counts = collections.Counter()

    @settings(
        max_examples=number,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
        report_multiple_bugs=False,
    )
    @given(examples)
    def check(example):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            counts[outcome(example)] += 1

    torch.set_num_threads(1)
    try:
        check()
    except Exception as error:
        return dict(counts), ["\n".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])])]
    return dict(counts), []
