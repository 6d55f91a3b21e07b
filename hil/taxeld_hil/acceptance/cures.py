"""Cures for findings, and the names of a source's counters in words."""

POWER = (
    "check that the hub has power, that CAN-H and CAN-L are not exchanged, and that the bus ends "
    "in 120 Ω at both ends and runs at 1 Mbit/s"
)
KIND = "check the target's kind (can, slcan or serial) and its bit rate or baud rate"
ADAPTER = "check the adapter's plug, cable and supply, and that no other program uses it"
HOST = "stop any other host that drives this hub, and switch the hub off and on"
FIRMWARE = "switch the hub off and on; else load its firmware anew, with the vendor's tool"
SPI = "check the cable from the hub to the module and its neighbours; switch the hub off and on"
LAYOUT = "give this skin's layout file, or correct the serial numbers in it"
MASK = (
    "set the module's mask (MODULE_SET_CUT_SENSORS; bit 0 is T0) and switch the hub off and on, or "
    "mark the taxels that it leaves out as cut in the layout"
)
FEWER = "ask for fewer scans (--period-ms, and source.period_ms of the daemon)"
BUSY = (
    "close other programs on this machine; on a USB serial adapter set its latency timer to 1 ms "
    "(/sys/bus/usb-serial/devices/*/latency_timer)"
)
WIRES = f"check the bus's ends (120 Ω at both), its shield and the length of its stubs; else {BUSY}"
TABLE = "two hubs may share a short id: connect one at a time, and switch it off and on"
GROUND = (
    "run once more with the skin untouched; then check the ground between skin, hub and robot, "
    "and keep motor cables away; a single taxel can be marked as cut in the layout"
)
TAXEL = (
    "check that the module's dielectric is on and dry and that its surface is not cut; if only "
    "this taxel fails, mark it as cut in the layout: the daemon works without it"
)
MODULE = "the whole module fails: check its cable and supply, then replace the module"
T0 = "run once more, untouched; then check the module's supply. Its drift is not compensated"
PRESS = (
    "press once more, harder, on the module that was named; then check its cable, and its serial "
    "number in the layout file"
)
SWAPPED = "exchange the two on the link, or their serial numbers in the layout file"
HARDER = (
    "press harder and run once more; if it stays so, set skin.full_scale_counts of the daemon to "
    "what a firm press reads, or see whether the dielectric has hardened"
)
SILENCE = {  # no hub declares its modules: the first counter that is not 0 has the cure
    "lost": ADAPTER,
    "bootloader": FIRMWARE,
    "packets": HOST,
    "frames": KIND,
    "refused": ADAPTER,
    "bytes": KIND,
    "unsent": POWER,
}
COUNTED = {  # counters of a source, in words
    "lost": "times the adapter went away",
    "silences": "times the adapter fell silent",
    "bootloader": "answers from a hub's bootloader",
    "packets": "CySkin packets, none of them an answer to DECLARE",
    "frames": "CAN frames",
    "bytes": "bytes",
    "crc_errors": "packets with a wrong checksum",
    "length_errors": "packets of a wrong length",
    "index_errors": "packets past the module table",
    "malformed": "packets that their command does not allow",
    "noise": "reads that the driver could not decode",
    "orphan": "frames without the beginning of their packet",
    "unknown": "frames or packets of other devices",
    "unsent": "requests that could not be sent",
    "refused": "lines that the adapter refused, named above",
}
