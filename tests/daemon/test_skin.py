"""Counts to activations."""

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.skin.skin import Skin
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.modules import Module, wired

BASE = 10_000


def scan(skin: Layout, taxels: dict[int, int], t: float = 0.0, base: int = BASE) -> Scan:
    """A scan of the layout's wiring: T0 at 1, taxel i at base + taxels[i]."""
    modules = tuple(wired(skin.uid.tolist()))
    index = {int(uid): i for i, uid in enumerate(skin.uid)}
    counts = []
    for uid in (uid for module in modules for uid in module.uids):
        i = index.get(uid)
        counts.append(1 if i is None else base + taxels.get(i, 0))
    return Scan(t, 1, tuple(counts), modules, 1)


def tared(skin: Layout, noise: int = 0) -> Skin:
    subject = Skin(skin, SkinConfig())
    rng = np.random.default_rng(0)
    for _ in range(20):
        jitter = {i: int(v) for i, v in enumerate(noise * rng.standard_normal(len(skin)))}
        assert subject.on_scan(scan(skin, jitter)) is None
    return subject


def test_activation_is_counts_over_baseline_by_full_scale(skin: Layout) -> None:
    activation = tared(skin).on_scan(scan(skin, {0: 10_000, 31: 30_000}, t=4.5))
    assert activation is not None
    assert activation.t == 4.5
    assert activation.z[0] == 0.5
    assert activation.z[31] == 1.0
    assert activation.live.all()
    assert np.count_nonzero(activation.z) == 2


def test_idle_noise_is_no_touch_and_each_taxel_has_its_own_threshold(skin: Layout) -> None:
    quiet, loud = tared(skin), tared(skin, noise=130)
    press = scan(skin, {5: 500})
    felt = quiet.on_scan(press)
    lost = loud.on_scan(press)
    assert felt is not None
    assert lost is not None
    assert felt.z[5] > 0
    assert lost.z[5] == 0


@pytest.mark.parametrize("invalid", [-BASE, 0xFFFF - BASE, 43_000 - BASE])
def test_invalid_counts_are_not_live(skin: Layout, invalid: int) -> None:
    subject = tared(skin)
    activation = subject.on_scan(scan(skin, {7: invalid}))
    assert activation is not None
    assert not activation.live[7]
    assert activation.z[7] == 0
    assert activation.live.sum() == len(skin) - 1


def test_a_lost_channel_is_not_live_and_not_remembered(skin: Layout) -> None:
    subject = tared(skin)
    subject.on_scan(scan(skin, {0: 9_000}))
    whole = scan(skin, {0: 9_000})
    counts = list(whole.counts)
    counts[1] = MISSING  # channel 0 is T0, channel 1 taxel 0
    activation = subject.on_scan(Scan(1.0, 1, tuple(counts), whole.table, 1))
    assert activation is not None
    assert not activation.live[0]
    assert activation.z[0] == 0


def test_tare_learns_the_baseline_anew(skin: Layout) -> None:
    subject = tared(skin)
    subject.tare()
    for _ in range(20):
        assert subject.on_scan(scan(skin, {}, base=12_000)) is None
    activation = subject.on_scan(scan(skin, {1: 2_000}, base=12_000))
    assert activation is not None
    assert activation.z[1] == 0.1


def test_modules_of_another_skin_are_counted(skin: Layout) -> None:
    subject = Skin(skin, SkinConfig())
    alien = Scan(0.0, 1, (5, 6), (Module(2, sui=999, mask=0b110),), 1)
    assert subject.on_scan(alien) is None
    assert subject.counters.unmapped == 1


def test_a_new_table_remaps_the_channels(skin: Layout) -> None:
    """The same taxels after their hub declared its modules in another order."""
    subject = tared(skin)
    old = scan(skin, {0: 10_000})
    first = old.table[0].channels
    rest = old.counts[first:]
    moved = Scan(1.0, 1, rest + old.counts[:first], old.table[1:] + old.table[:1], 2)
    activation = subject.on_scan(moved)
    assert activation is not None
    assert activation.z[0] == 0.5
    assert np.count_nonzero(activation.z) == 1
