"""Following new rows one by one, against the posterior given all rows at once; and what stays as it is."""

import pytest
import torch

from gym_dgpmpc.data.standardised import Data
from gym_dgpmpc.errors import FactorisationError
from gym_dgpmpc.gp.deep_gp import Factorised, factorise_all
from gym_dgpmpc.gp.layer import conditional
from gym_dgpmpc.inference.following import BLOCK, Follower
from gym_dgpmpc.inference.gradients import forward, prepare
from gym_dgpmpc.inference.last_layer import LastLayerEvidence, last_layer_evidence
from tests.oracles.models import chains, make_model, normal, seeded

START, END = BLOCK - 4, 2 * BLOCK + 6
"""Rows that were trained on, and all that there are in the end: two blocks become whole in between."""


def problem(num_layers, num_chains=2):
    """Factorised models, where the chains are, 1000 rows, and latents of the first."""
    generator = seeded(3)
    model = chains(*(make_model(num_layers, 2, 2, 5, generator, "matern32") for _ in range(num_chains)))
    position = normal(generator, num_chains, model.num_whitened())
    data = Data(normal(generator, 1000, 2), normal(generator, 1000, 2))
    latents = [normal(generator, num_chains, START, 2).float() for _ in range(num_layers - 1)]
    return factorise_all(model), position, data, latents


def follower(factorised, position):
    return Follower(factorised.model, position[:, : factorised.model.num_inner()])


def first(data, num_rows):
    return Data(data.x[:num_rows], data.y[:num_rows])


def walk(following, position, data, latents, sizes, generator):
    """Follow data of these sizes; before each, where the chains are and the generator's state, and what came out.

    The chains go on where the last draw is, as those of the model do.
    """
    steps = []
    for num_rows in sizes:
        state = generator.get_state()
        followed = following.follow(position, first(data, num_rows), latents, 3, generator)
        steps.append((num_rows, position, latents, state, followed))
        position, latents = followed.positions[-1], followed.latents
    return steps


def expected(factorised, position, data, latents):
    """The last layer's posterior given all rows, by one sum."""
    prepared, by_layer = prepare(factorised.model), factorised.model.split(position)
    x = data.x.expand(len(position), -1, -1)
    passed = forward(prepared, by_layer, x, [latent.double() for latent in latents])
    return last_layer_evidence(prepared, passed[-1], data.y).posterior()


def equal(one, other):
    return torch.equal(one.positions, other.positions) and all(
        torch.equal(a, b) for a, b in zip(one.latents, other.latents, strict=True)
    )


@pytest.fixture
def posteriors(monkeypatch):
    """Every posterior that is drawn from."""
    seen, original = [], LastLayerEvidence.posterior

    def watched(self, *args):
        seen.append(original(self, *args))
        return seen[-1]

    monkeypatch.setattr(LastLayerEvidence, "posterior", watched)
    return seen


@pytest.mark.parametrize(("num_layers", "step"), [(1, 1), (2, 1), (2, BLOCK + 9), (3, 3)])
def test_row_by_row_is_the_posterior_given_all_rows_at_once(num_layers, step, posteriors):
    """Given the latents that came out. Across block boundaries, one row, a few, or more than a block at a time."""
    factorised, position, data, latents = problem(num_layers)
    steps = walk(follower(factorised, position), position, data, latents, range(START, END, step), seeded())
    drawn_from, inner = list(posteriors), factorised.model.num_inner()
    assert len(drawn_from) == len(steps)
    for (num_rows, *_, followed), found in zip(steps, drawn_from, strict=True):
        assert [latent.shape for latent in followed.latents] == [(2, num_rows, 2)] * (num_layers - 1)
        assert all(latent.dtype == torch.float32 for latent in followed.latents)
        wanted = expected(factorised, position, first(data, num_rows), followed.latents)
        # Rounding of 1e-16 times the condition number of K_zz, at most M / jitter, and that of the precision.
        torch.testing.assert_close(found.mean, wanted.mean, rtol=0, atol=1e-7)
        torch.testing.assert_close(found.precision_factor, wanted.precision_factor, rtol=0, atol=1e-7)
        without_last = expected(factorised, position, first(data, num_rows - 1), [x[:, :-1] for x in followed.latents])
        assert (without_last.mean - wanted.mean).abs().max() > 1e-4, "a row tells"
        assert followed.positions.shape == (3, 2, factorised.model.num_whitened())
        assert torch.equal(followed.positions[..., :inner], position[:, :inner].expand(3, -1, -1))


def test_samples_are_of_that_posterior(posteriors):
    """One layer has no latents, so that nothing else is drawn."""
    factorised, position, data, _ = problem(1)
    followed = follower(factorised, position).follow(position, first(data, END), [], 4, seeded(8))
    assert torch.equal(followed.positions, posteriors[-1].positions(position[:, :0], 4, seeded(8)))
    assert len(followed.positions[:, 0].unique(dim=0)) == 4


@pytest.mark.parametrize(("num_layers", "step"), [(1, 1), (2, 1), (3, 3)])
def test_one_made_afresh_goes_on_bit_by_bit(num_layers, step):
    """As after loading: wherever the rows stand to a block, positions and latents are the same from there on."""
    factorised, position, data, latents = problem(num_layers)
    steps = walk(follower(factorised, position), position, data, latents, range(START, END, step), seeded())
    sizes = [num_rows for num_rows, *_ in steps]
    for index, (num_rows, at, given, state, _) in enumerate(steps):
        if min(abs(num_rows - whole) for whole in (BLOCK, 2 * BLOCK)) > 2:
            continue
        generator = torch.Generator()
        generator.set_state(state)
        copies = [latent.clone(memory_format=torch.contiguous_format) for latent in given]
        again = walk(follower(factorised, at), at.clone(), data, copies, sizes[index : index + 4], generator)
        for one, other in zip(steps[index:], again, strict=False):
            assert equal(one[-1], other[-1]), (num_rows, one[0])


@pytest.mark.parametrize("num_layers", [2, 3])
def test_latents_of_settled_blocks_stay_and_the_others_move(num_layers):
    factorised, position, data, latents = problem(num_layers)
    moved = [torch.zeros(2, END, dtype=torch.bool) for _ in latents]
    steps = walk(follower(factorised, position), position, data, latents, range(START + 1, END), seeded())
    for _, _, before, _, followed in steps:
        settled = before[0].shape[1] // BLOCK * BLOCK
        for index, (old, new) in enumerate(zip(before, followed.latents, strict=True)):
            changed = (old != new[:, : old.shape[1]]).any(-1)
            assert not changed[:, :settled].any()
            moved[index][:, : old.shape[1]] |= changed
    # From the last row that is given ten moves or more on, each of which is accepted half of the time.
    unsettled = slice(BLOCK, 2 * BLOCK - 10)
    for each in moved:
        assert each[:, unsettled].all() and each[:, START - 4 : START].any()


@pytest.mark.parametrize("num_layers", [1, 2])
@pytest.mark.parametrize(
    ("field", "value"), [("x", float("nan")), ("x", 1e200), ("y", float("nan")), ("y", -float("inf"))]
)
@pytest.mark.parametrize("bad_row", [BLOCK - 1, BLOCK + 3])
def test_bad_data_are_an_error_that_changes_nothing(num_layers, field, value, bad_row):
    """Not finite, or so large that squares overflow; in a block that becomes whole, or in the rest.

    The next call is that of one which never saw them.
    """
    factorised, position, data, latents = problem(num_layers)
    follow, unspoilt = follower(factorised, position), follower(factorised, position)
    given = [latent.clone() for latent in latents]
    for each in (follow, unspoilt):
        each.follow(position, first(data, START), latents, 2, seeded(1))
    bad = Data(data.x.clone(), data.y.clone())
    getattr(bad, field)[bad_row, 1] = value
    with pytest.raises(FactorisationError, match="finite"):
        follow.follow(position, first(bad, BLOCK + 5), latents, 2, seeded(2))
    assert all(torch.equal(a, b) for a, b in zip(given, latents, strict=True))
    for num_rows in (BLOCK + 5, 2 * BLOCK + 1):
        one, other = (
            each.follow(position, first(data, num_rows), latents, 2, seeded(num_rows)) for each in (follow, unspoilt)
        )
        assert equal(one, other) and one.positions.isfinite().all()
        latents = one.latents


def test_only_rows_of_the_newest_blocks_are_asked_for():
    """The cost of a row does not grow with the data."""
    factorised, position, data, _ = problem(2)
    asked = []

    class Watched:
        num_rows = property(lambda self: self.data.num_rows)

        def __init__(self, data):
            self.data = data

        def rows(self, index):
            asked.extend(index.tolist())
            return self.data.rows(index)

    latents = [torch.zeros(2, 990, 2)]
    following = follower(factorised, position)
    latents = following.follow(position, Watched(first(data, 990)), latents, 1, seeded()).latents
    assert set(asked) == set(range(990)), "once all"
    for num_rows in range(991, 1000):
        asked.clear()
        latents = following.follow(position, Watched(first(data, num_rows)), latents, 1, seeded()).latents
        assert min(asked) >= (num_rows - 1) // BLOCK * BLOCK
        assert len(asked) <= 2 * (BLOCK + 1)


@pytest.mark.usefixtures("unchecked")
def test_moves_leave_the_latents_law_as_it_is():
    """Latents that start in it, by quadrature over the one of each row, given what the chains hold, stay in it.

    4000 chains of the same model at the same place: as many independent draws for each of three rows.
    """
    num_chains, generator = 4000, seeded(3)
    one = make_model(2, 1, 1, 6, generator, "matern32")
    inner, last = one.layers
    inner = inner._replace(log_variance=inner.log_variance + 1.5, log_lengthscale=inner.log_lengthscale - 1.5)
    one = one._replace(layers=(inner, last), log_noise=one.log_noise - 1.5)
    whitened = 1.5 * normal(generator, one.num_whitened())
    data = Data(torch.tensor([[0.4], [-0.9], [1.5]]).double(), torch.tensor([[0.8], [-1.0], [1.5]]).double())
    nodes = torch.linspace(-7.0, 7.0, 4001, dtype=torch.float64)
    law = latent_law(factorise_all(one), one.split(whitened), data, nodes)  # "N Q"
    first_moment = law @ nodes
    second = (law * (nodes - first_moment.unsqueeze(-1)).square()).sum(-1)
    fourth = (law * (nodes - first_moment.unsqueeze(-1)) ** 4).sum(-1)
    assert ((first_moment.abs() > 0.2) | ((second - 1.0).abs() > 0.2)).all(), "the data say something of each"
    latent = nodes[torch.multinomial(law, num_chains, replacement=True, generator=generator)].mT.unsqueeze(-1)

    factorised = factorise_all(chains(*[one] * num_chains))
    position, latents = whitened.expand(num_chains, -1), [latent.float()]
    following = follower(factorised, position)
    for _ in range(20):
        latents = following.follow(position, data, latents, 1, generator).latents
    found = latents[0][..., 0].double()
    assert ((found != latent.float()[..., 0]).double().mean(0) > 0.9).all(), "the chains went elsewhere"
    # Four standard errors; the grid's spacing of 0.0035 adds nothing to them.
    error = num_chains**-0.5
    assert ((found.mean(0) - first_moment).abs() < 4 * second.sqrt() * error).all()
    assert ((found.var(0) - second).abs() < 4 * (fourth - second.square()).sqrt() * error).all()


def latent_law(factorised: Factorised, by_layer, data, nodes):
    """p(e_n | y_n, v) of each row at the nodes, summing to one: those of a model of two layers, one number wide."""
    model, (inner_factor, last_factor) = factorised.model, factorised.factors
    mean, variance = conditional(model.layers[0], inner_factor, by_layer[0], data.x)
    hidden = data.x + mean + variance.sqrt().unsqueeze(-1) * nodes  # "N Q"
    mean, variance = conditional(model.layers[1], last_factor, by_layer[1], hidden.reshape(-1, 1))
    std = (variance.unsqueeze(-1) + model.noise_variance).sqrt()
    likelihood = torch.distributions.Normal(mean, std).log_prob(data.y.repeat_interleave(len(nodes), 0))
    return (likelihood.view(hidden.shape) - 0.5 * nodes.square()).softmax(-1)
