"""Proposals: poses that explain a touch, as far as each claims to."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.analytic import Manifold, Projection, Table, check_contacts
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.samples import PATIENCE, Samples
from tests.rig.commands import refuses
from tests.rig.configurations import config

from .conftest import DEPTH_MAX_M, scene_of

LIVE = np.ones(32, dtype=bool)


def touch(model: ObservationModel, seed: int) -> Floats:
    """The activations of a contact that is well felt."""
    rng = np.random.default_rng(seed)
    poses = contacts.synthesise(model.scene, model.layout.radius_m, DEPTH_MAX_M, 200, rng).pose
    h = model.activation(poses)
    return h[np.argmax(h.max(axis=1) > 0.3)]


@pytest.mark.parametrize("make", [Projection, Manifold, Table])
@pytest.mark.parametrize("n", [1, 7, 300])
def test_any_number_of_contact_poses_is_proposed(
    box_model: ObservationModel, make: type, n: int
) -> None:
    poses = make(box_model).propose(touch(box_model, 0), LIVE, n, np.random.default_rng(0))
    assert poses.shape == (n, 3)
    gap = contacts.clearance(box_model.scene, 0.04, poses)
    assert (np.abs(gap + DEPTH_MAX_M / 2) < DEPTH_MAX_M / 2 + 0.002).mean() > 0.95


@pytest.mark.parametrize(("make", "share"), [(Manifold, 0.9), (Table, 0.7)])
def test_the_informed_explain_the_touch_and_the_uninformed_do_not(
    box_model: ObservationModel, make: type, share: float
) -> None:
    proposals: list[Proposal] = [make(box_model), Projection(box_model)]

    def misfit(proposal: Proposal, seed: int) -> float:
        z = touch(box_model, seed)
        poses = proposal.propose(z, LIVE, 100, np.random.default_rng(seed))
        return float(np.median(np.abs(box_model.activation(poses) - z).sum(axis=1)))

    informed, uninformed = (np.array([misfit(p, seed) for seed in range(8)]) for p in proposals)
    assert np.median(informed / uninformed) < share


def test_on_a_disc_the_manifold_is_the_answer(disc_model: ObservationModel) -> None:
    """The centre of a round object lies where the touch points, as deep as it was felt."""
    for angle in np.arange(16) * np.pi / 8:
        truth = np.array([0.087 * np.cos(angle), 0.087 * np.sin(angle), 0.0])
        z = disc_model.activation(truth[None])[0]
        poses = Manifold(disc_model).propose(z, LIVE, 50, np.random.default_rng(0))
        assert np.abs(poses[:, :2] - truth[:2]).max() < 0.001


def test_the_table_answers_a_turned_touch_with_turned_poses(box_model: ObservationModel) -> None:
    table, rng, turns = (
        Table(box_model, size=2000),
        np.random.default_rng(0),
        box_model.layout.turns,
    )
    z, back = touch(box_model, 1), np.array([0.0, 0.0, -2 * np.pi * 5 / len(turns)])
    one, other = (table.propose(felt, LIVE, 20, rng) for felt in (z, z[turns[5]]))
    assert np.allclose(np.sort(se2.compose(back, one), axis=0), np.sort(other, axis=0), atol=1e-9)


@pytest.mark.parametrize("make", [Manifold, Table])
def test_dead_taxels_are_not_asked(box_model: ObservationModel, make: type) -> None:
    z, proposal = touch(box_model, 2), make(box_model)
    live = ~np.isin(np.arange(len(z)), np.flatnonzero(z == 0.0)[:5])
    honest, lying = (
        proposal.propose(felt, live, 30, np.random.default_rng(3))
        for felt in (z, np.where(live, z, 1.0))
    )
    assert np.array_equal(honest, lying)


def test_what_draws_contacts_gives_up_where_there_are_none(skin: Layout) -> None:
    nowhere = scene_of(lambda x, _y: np.ones_like(x), skin, symmetry=1)
    model = ObservationModel(nowhere, skin, DEPTH_MAX_M)
    for draw in (check_contacts, Table):
        refuses("no contact", draw, model)
    z = np.eye(1, len(skin))[0]
    assert Projection(model).propose(z, LIVE, 2, np.random.default_rng(0)).shape == (0, 3)


@pytest.fixture(scope="module")
def mug() -> Bundle:
    return bundle.load("mug", layouts.load(SkinConfig().layout), DEPTH_MAX_M)


@pytest.mark.parametrize("name", ["density", "ddpm", "table", "manifold", "projection"])
def test_a_bundle_serves_every_proposal(mug: Bundle, name: str) -> None:
    z = 0.6 * np.isin(np.arange(80), [3, 19])
    (known,) = choice.possible([mug], FilterConfig(proposal=name))
    assert known in (name, *(each.name for each in mug.manifest.samplers if each.kind == name))
    poses = mug.proposal(name).propose(z, z >= 0.0, 25, np.random.default_rng(0))
    assert (poses.shape, np.isfinite(poses).all()) == ((25, 3), True)
    assert mug.proposal(name).name == name


def test_auto_is_the_bundles_first_choice_that_fits_the_budget(
    mug: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    order = ["ddpm-100", "density-64", "table", "projection"]
    cost = {"ddpm": 12.0, "density": 0.3, "table": 0.6, "projection": 0.2}
    monkeypatch.setattr(choice, "cpu_ms", lambda proposal, _model, _samples: cost[proposal.name])
    chosen = [choice.choose(mug, order, 50, ms)[0] for ms in (20.0, 5.0, 0.25, 0.1)]
    assert chosen == ["ddpm-100", "density-64", "projection", "projection"]  # the cheapest at last
    assert choice.choose(mug, ["ddpm-100"], 50, 0.1)[0] == "ddpm-100"


def test_a_bundle_without_a_kind_of_sampler_says_so(mug: Bundle) -> None:
    bare = replace(mug, manifest=replace(mug.manifest, samplers=(), auto=()))
    refuses(r"has no 'ddpm'; it has auto, ", bare.proposal, "ddpm")
    assert bare.proposal("auto").name == "table"
    assert choice.possible([mug, bare], FilterConfig()) == list(mug.manifest.auto)


def test_after_late_touches_in_a_row_half_the_samples_are_drawn_until_a_reset() -> None:
    """`wanted` gives as many as are asked for."""
    wanted = Mock(propose=lambda _z, _live, n, _rng: np.zeros((n, 3)))
    samples = Samples([wanted, wanted])

    def drawn() -> list[int]:
        rng = np.random.default_rng(0)
        return [len(samples.of(k).propose(np.zeros(32), LIVE, 40, rng)) for k in range(2)]

    for _ in range(10):  # now and then a touch may take longer
        assert not any(samples.took(11.0, 10.0) for _ in range(PATIENCE - 1))
        assert not samples.took(9.0, 10.0)
    assert drawn() == [40, 40]
    assert [samples.took(11.0, 10.0) for _ in range(PATIENCE)] == [False] * (PATIENCE - 1) + [True]
    assert drawn() == [20, 20]
    assert not any(samples.took(11.0, 10.0) for _ in range(2 * PATIENCE)), "it is said once"
    samples.begin_anew()
    assert drawn() == [40, 40]


def test_a_warm_up_leaves_no_trace_in_the_belief(mug: Bundle) -> None:
    found = []
    for warm in (False, True):
        samples = choice.samples([mug], FilterConfig())
        pipeline = Pipeline(config(), [mug.model.layout], [mug.model], samples)
        if warm:
            pipeline.warm_up()
        found.append((pipeline.estimator.belief.particles.pose.tobytes(), pipeline.health()))
    assert found[0] == found[1]
