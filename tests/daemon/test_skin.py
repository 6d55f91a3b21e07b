"""Counts to activations, taxels that fail and come back, hubs that come and go, and foam."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model.observation import Activation
from taxeld.skin.foam import KEPT, Residue
from taxeld.skin.skin import Skin
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.modules import Module
from tests.rig.examples import examples
from tests.rig.simulated_skin import NOISE, PERIOD_S, SimulatedSkin, begun
from tests.rig.skins import SKIN

FROZEN_S = 12.0  # 200 scans, and the slice that they end in
BAD = 7
HAPPENINGS = [
    *("idle", "press", "free", "lost", "any", "zero", "full", "t0", "table", "pause", "tare"),
    "again",  # after a restart
]


@pytest.mark.parametrize(
    ("noise", "press", "seconds", "z"),
    [
        (0.0, {0: 10_000.0, 31: 30_000.0}, PERIOD_S, {0: 0.5, 31: 1.0}),
        (0.0, {5: 500.0}, PERIOD_S, {5: 0.025}),
        (130.0, {5: 500.0}, PERIOD_S, {}),  # each has a threshold of its noise
        (NOISE, {BAD: 30_000.0}, FROZEN_S, {BAD: 1.0}),  # below the invalid range
        (0.0, {}, FROZEN_S, {}),  # a skin without noise is not frozen
    ],
)
def test_an_activation_is_counts_over_baseline_by_full_scale(
    skin: Layout, noise: float, press: dict[int, float], seconds: float, z: dict[int, float]
) -> None:
    simulated, subject = begun(skin, noise=noise)
    simulated.noise = noise if seconds > PERIOD_S else 0.0
    simulated.press[list(press)] = list(press.values())
    activation = simulated.run(subject, seconds)
    assert activation.t == simulated.t
    assert activation.live.all()
    assert np.flatnonzero(activation.z).tolist() == list(z)
    assert activation.z[list(z)] == pytest.approx(list(z.values()), abs=0.01)


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
@examples(60)
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
        elif kind == "tare":
            subject.tare()
        elif kind == "again":
            state = subject.state()
            scans, subject = 0, Skin(skin, SkinConfig())
            if state is not None:
                subject.restore(state)
        version += kind == "table"
        simulated.t += 60.0 * times * (kind == "pause")
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


FULL = SkinConfig().full_scale_counts
PRESSED, FIRM, LIGHT = 40, 15_000.0, 500.0
FAST_S, SLOW_S = 1.0, 25.0


class Foam(SimulatedSkin):
    """A skin at rest, and the daemon's view of it."""

    def __init__(self) -> None:
        super().__init__(SKIN)
        self.skin = Skin(SKIN, SkinConfig())
        self.run(self.skin, 2.0)

    def hold(self, counts: float, seconds: float = 1.0) -> Activation:
        """Press one taxel alone; → the last activation."""
        self.press[:] = 0.0
        self.press[PRESSED] = counts
        return self.run(self.skin, seconds)


@pytest.fixture
def foam() -> Foam:
    return Foam()


@pytest.mark.parametrize("kept", [0.01, 0.025, 0.09, 0.25])
def test_what_foam_keeps_of_a_press_is_no_touch_and_a_light_touch_above_it_is_felt_at_once(
    foam: Foam, kept: float
) -> None:
    """Half of what it keeps stays for long."""
    assert foam.hold(FIRM).z[PRESSED] > 0.5
    for t in np.arange(0.0, 20.0, PERIOD_S):
        left = kept * FIRM * 0.5 * (np.exp(-t / FAST_S) + np.exp(-t / SLOW_S))
        assert not foam.hold(left, PERIOD_S).z.any()
    assert foam.hold(left + LIGHT, PERIOD_S).z[PRESSED] > 0.0


@pytest.mark.parametrize(
    "story",
    [
        # more than the threshold, and much less than foam may keep of the firm touch
        [(FIRM, 1.0, True), (0.0, 2.0, False), (2_000.0, 1.0, True), (400.0, 5.0, False)],
        [(1_000.0, 10.0, True)] * 12,  # as long as it is held
    ],
)
def test_a_touch_is_felt_and_what_it_leaves_is_not(
    foam: Foam, story: list[tuple[float, float, bool]]
) -> None:
    for counts, seconds, is_felt in story:
        for _ in range(round(seconds / PERIOD_S)):
            assert (foam.hold(counts, PERIOD_S).z[PRESSED] > 0.02) == is_felt


def test_an_activation_has_what_foam_may_hide_and_keep_and_no_baseline_follows_it(
    foam: Foam,
) -> None:
    threshold = foam.skin.threshold / FULL
    assert foam.run(foam.skin, PERIOD_S).floor == pytest.approx(threshold)
    foam.hold(FIRM)
    before = foam.skin.baseline[PRESSED]
    activation = foam.hold(0.1 * FIRM, 0.5)  # foam, or a touch that is lighter now
    assert activation.z[PRESSED] == 0.0
    assert activation.residue[PRESSED] == pytest.approx(0.1 * FIRM / FULL, abs=0.02)
    assert activation.floor[PRESSED] > 0.1 * FIRM / FULL
    foam.press[PRESSED + 1] = LIGHT
    assert foam.run(foam.skin, 0.3).z[PRESSED + 1] > 0.0
    foam.hold(0.1 * FIRM, 60.0)
    assert foam.skin.baseline[PRESSED] == pytest.approx(before, abs=10.0)


def test_a_press_is_over_when_it_has_fallen_to_its_share() -> None:
    foam = Residue(1)
    for over, pressed, level in (
        (50.0, False, 0.0),  # under the threshold
        (1000.0, True, 0.0),
        (1001.0 * KEPT, True, 0.0),
        (999.0 * KEPT, False, 999.0 * KEPT),
        (100.0, False, 100.0),
        (150.0, False, 100.0),  # within the threshold of the least since
        (201.0, True, 100.0),
        (100.0 + 0.9 * KEPT * 101.0, False, 100.0 + 0.9 * KEPT * 101.0),
        (-20.0, False, 0.0),
    ):
        foam.on_scan(np.array([over]), np.array([100.0]))
        assert (foam.pressed[0], foam.level[0]) == (pressed, pytest.approx(level))
