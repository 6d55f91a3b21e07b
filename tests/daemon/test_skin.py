"""Counts to activations, taxels that fail and come back, and hubs that come and go."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.skin.skin import Skin
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.modules import Module
from tests.rig.simulated_skin import SimulatedSkin, begun

FROZEN_S = 12.0  # 200 scans, and the slice that they end in
BAD = 7
HAPPENINGS = [
    *("idle", "press", "free", "lost", "any", "zero", "full", "t0", "table", "pause", "tare"),
    "again",  # after a restart
]


def test_an_activation_is_counts_over_baseline_by_full_scale(skin: Layout) -> None:
    simulated, subject = begun(skin, noise=0.0)
    simulated.press[[0, 31]] = 10_000.0, 30_000.0
    activation = simulated.run(subject, 0.05)
    assert activation.t == simulated.t
    assert activation.z[[0, 31]] == pytest.approx([0.5, 1.0], abs=1e-4)
    assert activation.live.all()
    assert np.count_nonzero(activation.z) == 2


@pytest.mark.parametrize(("noise", "is_felt"), [(0.0, True), (130.0, False)])
def test_each_taxel_has_a_threshold_of_its_noise(skin: Layout, noise: float, is_felt: bool) -> None:
    simulated, subject = begun(skin, noise=noise)
    simulated.press[5], simulated.noise = 500.0, 0.0
    assert (simulated.run(subject, 0.05).z[5] > 0.0) == is_felt


@pytest.mark.parametrize(
    ("reads", "lists"),
    [
        (MISSING, ["dead_taxels"]),
        (0, ["dead_taxels"]),
        (0xFFFF, ["dead_taxels", "saturated_taxels"]),
        (43_000, ["dead_taxels", "saturated_taxels"]),
        (10_000, ["dead_taxels", "stuck_taxels"]),
        (25_000, ["dead_taxels", "stuck_taxels"]),
    ],
)
def test_a_taxel_that_reads_one_thing_is_masked_until_it_recovers(
    skin: Layout, reads: int, lists: list[str]
) -> None:
    simulated, subject = begun(skin)
    simulated.press[BAD] = 9_000.0
    simulated.run(subject, 0.05)
    simulated.press[BAD], simulated.fixed[BAD] = 0.0, reads
    activation = simulated.run(subject, FROZEN_S)
    assert np.flatnonzero(~activation.live).tolist() == [BAD]
    assert activation.z[BAD] == 0.0
    faults = {name: taxels for name, taxels in subject.faults().items() if taxels}
    assert faults == {name: [BAD] for name in lists}
    del simulated.fixed[BAD]
    assert simulated.run(subject, 2.0).live.all()
    assert not any(subject.faults().values())


def test_a_hard_press_below_the_invalid_range_is_full_scale(skin: Layout) -> None:
    simulated, subject = begun(skin)
    simulated.base[BAD], simulated.press[BAD] = 10_000.0, 32_000.0
    activation = simulated.run(subject, FROZEN_S)
    assert activation.live[BAD]
    assert activation.z[BAD] == 1.0


def test_a_skin_without_noise_is_not_frozen(skin: Layout) -> None:
    simulated, subject = begun(skin, noise=0.0)
    assert simulated.run(subject, FROZEN_S).live.all()


def test_tare_learns_the_baseline_anew(skin: Layout) -> None:
    simulated, subject = begun(skin)
    simulated.base += 2_000.0
    subject.tare()
    assert subject.on_scan(simulated.scan()) is None
    simulated.run(subject, 1.0)
    simulated.press[1] = 2_000.0
    assert simulated.run(subject, 0.05).z[1] == pytest.approx(0.1, abs=0.02)


def test_modules_of_another_skin_are_counted(skin: Layout) -> None:
    subject = Skin(skin, SkinConfig())
    assert subject.on_scan(Scan(0.0, 1, (5, 6), (Module(2, sui=999, mask=0b110),), 1)) is None
    assert subject.counters.unmapped == 1


def test_a_hub_that_declares_its_modules_in_another_order_is_mapped_anew(skin: Layout) -> None:
    simulated, subject = begun(skin)
    simulated.press[0] = 10_000.0
    old = simulated.scan()
    first = old.table[0].channels
    counts, table = old.counts[first:] + old.counts[:first], old.table[1:] + old.table[:1]
    activation = subject.on_scan(replace(old, counts=counts, table=table, table_version=2))
    assert activation is not None
    assert np.flatnonzero(activation.z).tolist() == [0]


def test_a_hub_that_falls_silent_holds_no_touch(skin: Layout) -> None:
    """Its taxels' last readings age: they are dead, not pressed for ever."""
    simulated, subject = begun(skin)
    simulated.press[0] = 8_000.0
    whole = simulated.scan()
    assert subject.on_scan(whole) is not None
    first = sum(module.channels for module in whole.table[:2])
    for k in range(20):
        rest = Scan(whole.t + 0.05 * k, 2, whole.counts[first:], whole.table[2:], 1)
        activation = subject.on_scan(rest)
    assert activation is not None
    assert not activation.z.any()
    assert (activation.live == (np.arange(len(skin)) >= 20)).all()


def counts_of(kind: str, simulated: SimulatedSkin, taxel: int) -> tuple[int, ...]:
    counts = list(simulated.scan().counts)
    channel = int(np.flatnonzero(simulated.taxel == taxel)[0])
    if kind == "lost":
        counts[channel:] = [MISSING] * (len(counts) - channel)
    elif kind in ("any", "t0"):
        counts[channel if kind == "any" else 0] = int(simulated.rng.integers(0, 0x10000))
    elif kind in ("zero", "full"):
        counts = [0xFFFF * (kind == "full")] * len(counts)
    return tuple(counts)


@given(
    st.lists(
        st.tuples(st.sampled_from(HAPPENINGS), st.integers(0, 31), st.integers(1, 60)), max_size=25
    )
)
@settings(max_examples=60, deadline=None)
def test_whatever_comes_the_state_is_finite_and_the_masks_agree(
    skin: Layout, story: list[tuple[str, int, int]]
) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    version, scans = 1, 0
    for kind, taxel, times in story:
        if kind == "press":
            simulated.press[taxel] = 300.0 * times
        elif kind == "free":
            simulated.press[:] = 0.0
        elif kind == "table":
            version += 1
        elif kind == "pause":
            simulated.t += 60.0 * times
        elif kind == "tare":
            subject.tare()
        elif kind == "again":
            state = subject.state()
            scans, subject = 0, Skin(skin, SkinConfig())
            if state is not None:
                subject.restore(state)
        for _ in range(times):
            scans += 1
            counts = counts_of(kind, simulated, taxel)
            activation = subject.on_scan(Scan(simulated.t, 1, counts, simulated.modules, version))
            if activation is None:
                continue
            faults = subject.faults()
            assert activation.t == simulated.t
            assert ((activation.z >= 0.0) & (activation.z <= 1.0)).all()
            assert not activation.z[~activation.live].any()
            assert np.flatnonzero(~activation.live).tolist() == faults["dead_taxels"]
            assert {*faults["saturated_taxels"], *faults["untared_taxels"]} <= {
                *faults["dead_taxels"]
            }
        assert np.isfinite(subject.baseline).all()
        assert subject.counters.scans == scans
