"""What the door may use, so that the kernel ends the door and nothing else."""

import resource

MEMORY_BYTES = 192 << 20  # data of the process, stacks included
DESCRIPTORS = 16_384  # without one left ZeroMQ ends the process


def limit() -> None:
    """Bounds on memory, descriptors, files and priority."""
    for what, most in (
        (resource.RLIMIT_DATA, MEMORY_BYTES),
        (resource.RLIMIT_NOFILE, DESCRIPTORS),
        (resource.RLIMIT_MEMLOCK, 0),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_RTPRIO, 0),
    ):
        hard = resource.getrlimit(what)[1]
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (least, least))


def start_no_more() -> None:
    """No further thread or process; of root the kernel does not ask this."""
    resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
