"""Acceptance: whether the hub answers, and whether its modules are those of the layout."""

from collections import Counter

from taxeld.skin.channels import TEMPERATURE
from taxeld_hil.acceptance.values import CheckResult, Finding, Received, listed
from taxeld_protocol.modules import NAMES, Module, wired

LISTED = 8  # modules of one kind of fault that get a line each

_POWER = (
    "check that the hub has power, that CAN-H and CAN-L are not exchanged, that the bus ends in "
    "120 Ω at both ends and runs at 1 Mbit/s; on a serial device, that the target's kind (slcan or "
    "serial) is the right one"
)
_SPI = (
    "check the cable from the hub to this module and its neighbours, then switch the hub off and on"
)
_LAYOUT = "give the layout file of this skin, or correct the serial number in it"


def discovery(received: Received) -> CheckResult:
    """The hub answers the daemon's own bring-up, declares all its modules, and sends scans."""
    tables = received.tables
    findings = [_silence(received)] if not tables else []
    for hub, modules in tables.items():
        unknown = [str(i) for i, m in enumerate(modules) if m.channels and m.sui is None]
        if unknown:
            findings.append(
                Finding(
                    f"hub {hub}", f"no details of the modules at positions {listed(unknown)}", _SPI
                )
            )
        elif not any(module.channels for module in modules):
            findings.append(Finding(f"hub {hub}", "declares no module with a channel", _SPI))
    if tables and not findings:
        findings += [
            Finding(
                f"hub {hub}",
                "answers, but sent no scan after auto sync was switched on",
                "switch the hub off and on; if it stays silent, its module application does not "
                "run (MODULE_PROGRAM_END) and the firmware has to be loaded again",
            )
            for hub in tables
            if not any(scan.ihb == hub for scan in received.scans)
        ]
    parts = [
        f"hub {hub}: {sum(1 for m in modules if m.channels)} modules, "
        f"{sum(m.channels for m in modules)} channels"
        for hub, modules in tables.items()
    ]
    return CheckResult("discovery", "; ".join(parts) or "no hub answered", findings)


def _silence(received: Received) -> Finding:
    """Why no hub may have declared itself."""
    link = received.bring_up
    if link.lost:
        return Finding("the adapter", "went away while it was used", "check its plug and cable")
    if link.refused and not link.frames:
        return Finding(
            "the adapter",
            f"refused {link.refused} lines, and nothing came from it",
            "it is said above which: its firmware must know them; else give it another",
        )
    if link.bootloader:
        return Finding(
            "the hub",
            f"answers from its bootloader ({link.bootloader} ×), and does not leave it",
            "switch it off and on; if it stays there, its modules lack their firmware, which the "
            "vendor's tool loads",
        )
    if link.packets:
        return Finding(
            "the bus",
            f"{link.packets} CySkin packets came, but no answer to DECLARE",
            "stop whatever else drives this hub, switch the hub off and on and try again",
        )
    if link.frames or link.bytes:
        heard = f"{link.frames} frames" if link.frames else f"{link.bytes} bytes"
        return Finding(
            "the bus",
            f"{heard} came, none of them CySkin's",
            "check the target's kind (can, slcan or serial), its bit rate or baud rate, and that "
            "the hub is past its bootloader",
        )
    sent = f", and {link.unsent} requests could not be sent" if link.unsent else ""
    return Finding("the bus", f"nothing at all was heard{sent}", _POWER)


def modules(received: Received) -> CheckResult:
    """The modules that answered, compared with the layout: missing, unexpected, cut in another way,
    without T0."""
    name = "modules"
    found = [
        (module.sui, module)
        for table in received.tables.values()
        for module in table
        if module.sui is not None and module.channels
    ]
    if not found:
        return CheckResult(name, "no module is known", checked=False)
    expected = {m.sui: m for m in wired(received.layout.uid.tolist()) if m.sui is not None}
    places, answered = received.places, dict(found)
    missing = [sui for sui in expected if sui not in answered]
    unexpected = [sui for sui in answered if sui not in expected]
    findings = [_missing(sui, expected[sui], bool(unexpected)) for sui in missing[:LISTED]]
    findings += [_unexpected(sui, places[sui]) for sui in unexpected[:LISTED]]
    findings += _over("missing", missing) + _over("unexpected", unexpected)
    findings += _doubled([sui for sui, _ in found])
    notes = []
    for sui in sorted(expected.keys() & answered.keys()):
        where = f"module {sui} ({places[sui]})"
        findings += _channels(where, expected[sui], answered[sui])
        extra = _names(answered[sui].mask & ~expected[sui].mask)
        if extra:
            notes.append(f"{where}: {extra} are not in the layout; the daemon passes them over")
    there = len(expected) - len(missing)
    return CheckResult(
        name,
        f"{there} of the layout's {len(expected)} answered, {len(unexpected)} unexpected",
        findings,
        notes,
        {"missing": missing, "unexpected": unexpected},
    )


def _missing(sui: int, module: Module, others: bool) -> Finding:
    taxels = module.channels - 1  # of the layout; the last is T0
    replaced = ", or it was replaced by one that is listed as unexpected" if others else ""
    return Finding(
        f"module {sui}",
        f"did not answer; {taxels} taxels of the layout are without it",
        f"{_SPI}; else the layout is of another skin{replaced}",
    )


def _unexpected(sui: int, place: str) -> Finding:
    return Finding(
        f"module {sui} ({place})",
        "answers, but is not in the layout",
        f"{_LAYOUT}; a module that was replaced has a new one",
    )


def _doubled(serials: list[int]) -> list[Finding]:
    return [
        Finding(
            f"module {sui}",
            f"{times} modules answer to this serial number",
            "program one of them with a serial number of its own",
        )
        for sui, times in Counter(serials).items()
        if times > 1
    ]


def _over(kind: str, serials: list[int]) -> list[Finding]:
    rest = serials[LISTED:]
    if not rest:
        return []
    return [Finding(f"{len(rest)} more modules", f"{kind}: {listed([*map(str, rest)])}", _LAYOUT)]


def _channels(where: str, expected: Module, answered: Module) -> list[Finding]:
    """What is wrong with the channels of a module that is where it should be."""
    findings = []
    if answered.channels != answered.mask.bit_count():
        findings.append(
            Finding(
                where,
                f"sends {answered.channels} channels, but its mask {answered.mask:#05x} names "
                f"{answered.mask.bit_count()}: which taxel is which is not known",
                "set its mask again (MODULE_SET_CUT_SENSORS) and switch the hub off and on",
            )
        )
    absent = _names(expected.mask & ~answered.mask & ~(1 << TEMPERATURE))
    if absent:
        findings.append(
            Finding(
                where,
                f"its mask {answered.mask:#05x} leaves out {absent}, which the layout has",
                "set its mask (MODULE_SET_CUT_SENSORS), or mark these taxels as cut in the layout",
            )
        )
    if not answered.mask >> TEMPERATURE & 1:
        findings.append(
            Finding(
                where,
                f"its mask {answered.mask:#05x} has no T0: its drift cannot be told from a touch",
                "set bit 0 of its mask (MODULE_SET_CUT_SENSORS)",
            )
        )
    return findings


def _names(mask: int) -> str:
    return ", ".join(f"T{bit}" for bit in range(NAMES) if mask >> bit & 1)
