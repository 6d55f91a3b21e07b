"""What this version no longer has, each with what replaces it.

A configuration's key (`table.key`), a command (`taxeld-hil draw`) or an option (`--truth`) that
stands here is refused with its line. The table is emptied at the next minor version.
"""

GONE: dict[str, str] = {
    "taxeld watch": "'taxeld status' prints what a daemon believes, 'taxeld view' draws it",
    "taxeld-hil watch": "'taxeld status' prints what a daemon believes, 'taxeld view' draws it",
    "--sensor-tf": "examples/tf_to_pose.py publishes a frame of tf for --sensor-topic",
    "--sensor-endpoint": "CONFIG says where: sensor_pose.endpoint",
    "--z-m": "name a frame at that height with --frame",
    "--web": "use --save FILE, and where the browser is: rerun --web-viewer FILE",
    "taxeld export": "run taxeld-ros2 and record its topics with 'ros2 bag'",
}


def why(name: str) -> str | None:
    """One line about a key, command or option that is gone; None where it never was."""
    return f"{name}: is gone; {GONE[name]}" if name in GONE else None
