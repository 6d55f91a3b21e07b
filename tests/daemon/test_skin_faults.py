"""Taxels that fail while the skin runs, and come back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.skin.skin import Skin
from taxeld_protocol.decoder import MISSING, Scan
from tests.rig.simulated_skin import SimulatedSkin

FROZEN_S = 12.0  # 200 scans, and the slice that they end in
BAD = 7


def begun(skin: Layout, noise: float = 34.0) -> tuple[SimulatedSkin, Skin]:
    simulated, subject = SimulatedSkin(skin, noise=noise), Skin(skin, SkinConfig())
    simulated.run(subject, 2.0)
    return simulated, subject


@pytest.mark.parametrize(
    ("reads", "lists"),
    [
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
    simulated.fixed[BAD] = reads
    assert not simulated.run(subject, FROZEN_S).live[BAD]
    assert {name: taxels for name, taxels in subject.faults().items() if taxels} == {
        name: [BAD] for name in lists
    }
    del simulated.fixed[BAD]
    assert simulated.run(subject, 2.0).live.all()
    assert not any(subject.faults().values())


def test_a_hard_press_below_the_invalid_range_is_full_scale(skin: Layout) -> None:
    simulated, subject = begun(skin)
    simulated.base[BAD] = 10_000.0
    simulated.press[BAD] = 32_000.0
    activation = simulated.run(subject, FROZEN_S)
    assert activation.live[BAD]
    assert activation.z[BAD] == 1.0


def test_a_skin_without_noise_is_not_frozen(skin: Layout) -> None:
    simulated, subject = begun(skin, noise=0.0)
    assert simulated.run(subject, FROZEN_S).live.all()


def test_a_hub_that_falls_silent_holds_no_touch(skin: Layout) -> None:
    """Its taxels' last readings age: they are dead, not pressed for ever."""
    half = len(skin) // 2
    simulated, subject = begun(skin)
    simulated.press[0] = 8_000.0
    whole = simulated.scan()
    assert subject.on_scan(whole) is not None
    modules = whole.table[half // 10 + 1 :]
    first = sum(module.channels for module in whole.table[: half // 10 + 1])
    for k in range(20):
        rest = Scan(whole.t + 0.05 * k, 2, whole.counts[first:], modules, 1)
        activation = subject.on_scan(rest)
    assert activation is not None
    assert not activation.z.any()
    assert not activation.live[: 10 * (half // 10 + 1)].any()
    assert activation.live[10 * (half // 10 + 1) :].all()


def counts_of(kind: str, simulated: SimulatedSkin, taxel: int) -> tuple[int, ...]:
    counts = list(simulated.scan().counts)
    channel = int(np.flatnonzero(simulated.taxel == taxel)[0])
    if kind == "lost":
        counts[channel:] = [MISSING] * (len(counts) - channel)
    elif kind == "any":
        counts[channel] = int(simulated.rng.integers(0, 0x10000))
    elif kind == "all zero":
        counts = [0] * len(counts)
    elif kind == "all full":
        counts = [0xFFFF] * len(counts)
    elif kind == "t0":
        counts[0] = int(simulated.rng.integers(0, 0x10000))
    return tuple(counts)


happenings = st.tuples(
    st.sampled_from(
        [
            "idle",
            "press",
            "release",
            "lost",
            "any",
            "all zero",
            "all full",
            "t0",
            "other table",
            "pause",
            "tare",
            "restart",
        ]
    ),
    st.integers(0, 31),
    st.integers(1, 60),
)


@given(st.lists(happenings, max_size=25))
@settings(max_examples=60, deadline=None)
def test_whatever_comes_the_state_is_finite_and_the_masks_agree(
    skin: Layout, story: list[tuple[str, int, int]]
) -> None:
    simulated, subject = SimulatedSkin(skin), Skin(skin, SkinConfig())
    version, scans = 1, 0
    for kind, taxel, times in story:
        if kind == "press":
            simulated.press[taxel] = 300.0 * times
        elif kind == "release":
            simulated.press[:] = 0.0
        elif kind == "other table":
            version += 1
        elif kind == "pause":
            simulated.t += 60.0 * times
        elif kind == "tare":
            subject.tare()
        elif kind == "restart":
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
            assert np.isfinite(activation.z).all()
            assert activation.z.min() >= 0.0
            assert activation.z.max() <= 1.0
            assert not activation.z[~activation.live].any()
            assert np.flatnonzero(~activation.live).tolist() == faults["dead_taxels"]
            assert set(faults["saturated_taxels"]) <= set(faults["dead_taxels"])
            assert set(faults["untared_taxels"]) <= set(faults["dead_taxels"])
        assert np.isfinite(subject.baseline).all()
        assert subject.counters.scans == scans
