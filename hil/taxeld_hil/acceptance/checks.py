"""Acceptance: all checks, as functions of what was received and read."""

from taxeld_hil.acceptance.link import link, rate
from taxeld_hil.acceptance.modules import discovery, modules
from taxeld_hil.acceptance.press import press
from taxeld_hil.acceptance.readings import IdleReadings
from taxeld_hil.acceptance.taxels import noise, taxels, temperature
from taxeld_hil.acceptance.values import CheckResult, Received


def checks(received: Received, got: IdleReadings) -> list[CheckResult]:
    """All of them, in the order in which they are to be read."""
    return [
        discovery(received),
        modules(received),
        rate(received),
        link(received),
        noise(received, got),
        taxels(received, got),
        temperature(received, got),
        press(received),
    ]
