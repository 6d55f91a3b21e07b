"""A recorded session: a directory with what the skin and the robot sent."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path

from taxeld.errors import SetupError
from taxeld_protocol.frames import Frame, LogLine, parse_log_line

FRAMES, POSES, TRUTH, CONFIG = "frames.log", "sensor_pose.csv", "truth.csv", "config.toml"
POSE_COLUMNS = ["t", "x", "y", "theta"]

PoseRow = tuple[float, float, float, float]  # t, x, y, θ


def log_lines(path: Path) -> Iterator[LogLine]:
    """The lines of a candump log; damaged ones with no frame, empty ones left out.

    Raises:
        SetupError: the file cannot be read.
    """
    try:
        with path.open(encoding="ascii", errors="replace") as file:
            for number, text in enumerate(file, 1):
                if text.strip():
                    yield LogLine(number, parse_log_line(text.rstrip("\n")))
    except OSError as error:
        raise SetupError(f"{path}: unreadable log ({error.strerror})") from None


def read_frames(path: Path) -> list[Frame]:
    """All frames of a session's log, which must be whole.

    Raises:
        SetupError: the file is unreadable, empty, or damaged, with the line.
    """
    frames = []
    for line in log_lines(path):
        if line.frame is None:
            raise SetupError(
                f"{path}: line {line.number} is no candump line; the log is truncated or damaged"
            )
        frames.append(line.frame)
    if not frames:
        raise SetupError(f"{path}: holds no frames; the log is empty")
    return frames


def read_poses(path: Path) -> list[PoseRow]:
    """The rows of a pose file (`t,x,y,theta`).

    Raises:
        SetupError: the file is unreadable or damaged, with the line.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise SetupError(f"{path}: unreadable poses ({error})") from None
    if not rows or rows[0] != POSE_COLUMNS:
        raise SetupError(f"{path}: must begin with the line {','.join(POSE_COLUMNS)}")
    poses: list[PoseRow] = []
    for number, row in enumerate(rows[1:], 2):
        try:
            t, x, y, theta = map(float, row)
        except ValueError:
            raise SetupError(f"{path}: line {number} is not t,x,y,theta") from None
        if not all(map(math.isfinite, (t, x, y, theta))):
            raise SetupError(f"{path}: line {number} holds a value that is not finite")
        poses.append((t, x, y, theta))
    return poses
