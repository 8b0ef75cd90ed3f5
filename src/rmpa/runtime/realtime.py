"""``--realtime``: requests real-time scheduling and locked memory from the kernel, with a remedy for each refusal.

The loop's thread gets SCHED_FIFO, and worker threads get it with one priority less. With default scheduling a busy
process could keep a worker thread that holds the interpreter's lock from the CPU, and the loop would wait for that
lock (measured with two busy processes: 4 ms late at p99; with a real-time priority 0.2 ms). SCHED_RESET_ON_FORK
leaves all other threads and every child process at default scheduling.

Memory that is mapped at the start is read in and locked. Later mappings are locked page by page as they are used
(MCL_ONFAULT): otherwise the kernel would fill each new thread's stack and heap with zeros, 10 MB for each thread.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pwd
import resource
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.sizes import KIB

if TYPE_CHECKING:
    import ctypes
    from collections.abc import Iterable

    from rmpa.config.settings import RealtimeSettings

_log = logging.getLogger(__name__)

# Of mlockall(2): the same on all machines that ROS 1 runs on.
_MCL_CURRENT: Final = 1
_MCL_FUTURE: Final = 2
_MCL_ONFAULT: Final = 4
# Of prctl(2).
_PR_SET_TIMERSLACK: Final = 29
_PR_GET_TIMERSLACK: Final = 30
# Of capabilities(7).
_CAP_SYS_NICE: Final = 23
_MARKS_OF_CONTAINERS: Final = (Path("/.dockerenv"), Path("/run/.containerenv"))
_STATUS: Final = Path("/proc/self/status")
_CPU_DMA_LATENCY: Final = Path("/dev/cpu_dma_latency")
_held: list[int] = []
_RT_RUNTIME: Final = Path("/proc/sys/kernel/sched_rt_runtime_us")


@dataclass(frozen=True, slots=True)
class SchedulingRequest:
    """One request to the kernel, and its outcome.

    Args:
        name: What was requested, in a word or two.
        granted: Whether the request was granted, at least in part.
        text: How much was granted, or why the request was refused.
        remedy: What the user must change for the full request to be granted; may be empty.
    """

    name: str
    granted: bool
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        """One line, without the remedy."""
        return f"{self.name}: {self.text}" if self.granted else f"no {self.name}: {self.text}"


def apply(settings: RealtimeSettings) -> tuple[SchedulingRequest, ...]:
    """Request everything that the settings ask for, for the calling thread and the process; never raises.

    Each outcome is logged: at INFO if granted, else at WARNING with the remedy. Must be called from the loop's thread
    before other threads start, because they inherit its CPU affinity.

    Returns:
        The outcomes; empty if real time is not enabled.
    """
    if not settings.enabled:
        return ()
    requests = [_schedule(settings.priority), _timer_slack()]
    if settings.lock_memory:
        requests.append(_lock_memory())
    if settings.cpus:
        requests.append(_pin(settings.cpus))
    if settings.keep_awake:
        requests.append(_keep_awake())
    for request in requests:
        level, mark = (logging.INFO, "=") if request.granted else (logging.WARNING, "!")
        remedy = f". For more: {request.remedy}" if request.granted else f". To have it: {request.remedy}"
        _log.log(level, "%s realtime: %s%s", mark, request, remedy if request.remedy else "")
    return tuple(requests)


def refused(requests: Iterable[SchedulingRequest]) -> str:
    """One sentence about the requests that were refused, or an empty string."""
    names = [request.name for request in requests if not request.granted]
    return f"realtime: no {', no '.join(names)}; the agent's log says what would grant it" if names else ""


def worker_pool() -> ThreadPoolExecutor:
    """Threads for blocking work, with one real-time priority less than the calling thread.

    If the kernel refuses that, the threads have default scheduling.
    """
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    if policy != os.SCHED_FIFO:
        return ThreadPoolExecutor(thread_name_prefix="worker")
    priority = max(1, os.sched_getparam(0).sched_priority - 1)

    def initialize() -> None:
        with contextlib.suppress(OSError):
            _to_fifo(priority)

    return ThreadPoolExecutor(thread_name_prefix="worker", initializer=initialize)


# --- scheduling ------------------------------------------------------------------------------------------------


def _to_fifo(priority: int) -> None:
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def _schedule(priority: int) -> SchedulingRequest:
    name = "SCHED_FIFO"
    if limit := _killing_limit():
        text = f"a thread that works {limit} ms without a rest would be killed (RLIMIT_RTTIME)"
        return SchedulingRequest(name, False, text, _ways("LimitRTTIME=infinity"))
    try:
        _to_fifo(priority)
    except PermissionError as error:
        return _schedule_lower(name, priority, error)
    except OSError as error:
        return SchedulingRequest(name, False, f"{error.strerror} (priority {priority})", "priorities are 1 to 99")
    return SchedulingRequest(name, True, f"priority {priority}")


def _schedule_lower(name: str, priority: int, error: OSError) -> SchedulingRequest:
    """Take the priority that RLIMIT_RTPRIO allows, if it allows any."""
    _, allowed = resource.getrlimit(resource.RLIMIT_RTPRIO)
    lower = priority if allowed == resource.RLIM_INFINITY else min(allowed, priority)
    if lower > 0:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_RTPRIO, (allowed, allowed))
            _to_fifo(lower)
            if lower == priority:
                return SchedulingRequest(name, True, f"priority {priority}")
            return SchedulingRequest(
                name, True, f"priority {lower}, the limit, in place of {priority}", _priority_ways(priority)
            )
    if lower > 0 or _has_capability(_CAP_SYS_NICE):
        return _forbidden(name, error)
    return SchedulingRequest(name, False, f"{error.strerror}", _priority_ways(priority))


def _forbidden(name: str, error: OSError) -> SchedulingRequest:
    """Explain a refusal despite the capability: the kernel's settings, the control group or a seccomp filter."""
    if _RT_RUNTIME.is_file() and _RT_RUNTIME.read_text(encoding="ascii").strip() == "0":
        remedy = "sudo sysctl kernel.sched_rt_runtime_us=950000"
        return SchedulingRequest(name, False, "this kernel has real time switched off", remedy)
    return SchedulingRequest(
        name,
        False,
        f"{error.strerror}, although we have the right: our control group has no real time, or a filter forbids it",
        "write 950000 to cpu.rt_runtime_us of the group, after those above it (Docker: --cpu-rt-runtime=950000); "
        "systemd: RestrictRealtime=no",
    )


def _killing_limit() -> int:
    """Milliseconds of uninterrupted work after which the kernel kills a real-time thread; 0: never."""
    soft, _ = resource.getrlimit(resource.RLIMIT_RTTIME)
    if soft == resource.RLIM_INFINITY:
        return 0
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_RTTIME, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        return 0
    return max(1, soft // 1000)


def _timer_slack() -> SchedulingRequest:
    """Ask the kernel not to delay timers in order to coalesce them; it never delays those of a real-time thread."""
    libc = _libc()
    libc.prctl(_PR_SET_TIMERSLACK, 1)
    slack = libc.prctl(_PR_GET_TIMERSLACK)
    return SchedulingRequest("timer slack", 0 <= slack <= 1, f"{slack} ns")


# --- memory ----------------------------------------------------------------------------------------------------


def _lock_memory() -> SchedulingRequest:
    """Lock present and future mappings.

    Memory is only locked without a limit, or with CAP_IPC_LOCK: an agent that reaches RLIMIT_MEMLOCK is refused
    memory, or killed when its stack grows. The limit counts address space, which is ten times the used memory. A
    trial with a limit of 0 shows whether the process has the capability.
    """
    name = "memory lock"
    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    before = _resident()
    try:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    except (OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, hard))
        failed = _lock_all()
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (soft, hard))
    else:
        failed = _lock_all()
    if not failed:
        return SchedulingRequest(name, True, f"{_resident()} MB and all that comes ({before} MB before)")
    if soft == resource.RLIM_INFINITY:
        return SchedulingRequest(
            name, False, f"{failed}, although nothing limits it: a filter forbids it, or RAM is short"
        )
    text = f"{failed}; {soft // KIB} KiB may be locked (ulimit -l), and it takes unlimited"
    remedy = _ways(
        "LimitMEMLOCK=infinity",
        login="memlock unlimited",
        container="--ulimit memlock=-1",
        capability="cap_ipc_lock",
    )
    return SchedulingRequest(name, False, text, remedy)


def _lock_all() -> str:
    """Call mlockall; return why it failed, or an empty string."""
    libc = _libc()
    for flags in (_MCL_CURRENT, _MCL_FUTURE | _MCL_ONFAULT):
        if libc.mlockall(flags):
            error = os.strerror(_errno())
            libc.munlockall()
            return error
    return ""


def _resident() -> int:
    """Resident memory, MB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() // 1_000_000


# --- CPUs ------------------------------------------------------------------------------------------------------


def _pin(cpus: tuple[int, ...]) -> SchedulingRequest:
    name = "CPU affinity"
    wanted = set(cpus)
    try:
        os.sched_setaffinity(0, wanted)
    except (OSError, ValueError, OverflowError) as error:
        why = getattr(error, "strerror", None) or str(error)
        return SchedulingRequest(name, False, f"{_listed(wanted)}: {why}", _cpu_ways())
    got = os.sched_getaffinity(0)
    if got == wanted:
        return SchedulingRequest(name, True, _listed(got))
    return SchedulingRequest(name, True, f"{_listed(got)} only, in place of {_listed(wanted)}", _cpu_ways())


def _listed(cpus: set[int]) -> str:
    return f"CPU {', '.join(map(str, sorted(cpus)))}"


def _cpu_ways() -> str:
    return (
        f"we run on {_listed(os.sched_getaffinity(0))} of {os.cpu_count()}; realtime.cpus names some of them, "
        "and others are given by AllowedCPUs= of the systemd unit or --cpuset-cpus of the container"
    )


# --- idle states -----------------------------------------------------------------------------------------------


def _keep_awake() -> SchedulingRequest:
    """Restrict all CPUs to idle states without wake-up delay, for as long as this process lives.

    Uses the kernel's PM QoS (Documentation/power/pm_qos_interface). The request holds while the file is open, so the
    file is never closed. A wake-up between two CPUs of a virtual machine took 11 µs with it, 21 µs without.
    """
    name = "wakefulness"
    try:
        file = os.open(_CPU_DMA_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        text = f"this kernel has no {_CPU_DMA_LATENCY} (CONFIG_CPU_IDLE)"
        return SchedulingRequest(name, False, text, "boot with processor.max_cstate=1")
    except OSError as error:
        return SchedulingRequest(name, False, f"{error.strerror} ({_CPU_DMA_LATENCY})", _awake_ways())
    os.write(file, (0).to_bytes(4, sys.byteorder))
    _held.append(file)
    return SchedulingRequest(name, True, "no CPU goes into an idle state that it wakes from late")


def _awake_ways() -> str:
    if _in_container():
        return f"start the container with --device {_CPU_DMA_LATENCY}"
    rule = 'KERNEL=="cpu_dma_latency", MODE="0660", GROUP="realtime"'
    return f"put the line {rule} into /etc/udev/rules.d/60-rmpa.rules and the agent's user into that group"


# --- what would grant it ---------------------------------------------------------------------------------------


def _priority_ways(priority: int) -> str:
    return _ways(
        f"LimitRTPRIO={priority}",
        login=f"rtprio {priority}",
        container=f"--cap-add SYS_NICE or --ulimit rtprio={priority}",
        capability="cap_sys_nice",
    )


def _ways(unit: str, *, login: str = "", container: str = "", capability: str = "") -> str:
    """Name the ways to have a request granted; in a container its options come first, as only they have an effect."""
    ways = [f"start the container with {container}"] if container and _in_container() else []
    ways.append(f"put {unit} into the systemd unit")
    if login:
        ways.append(f"for a log-in put the line '{_user()} - {login}' into /etc/security/limits.d/rmpa.conf")
    if capability:
        ways.append(f"or run once: sudo setcap {capability}+ep {Path(sys.executable).resolve()}")
    return "; ".join(ways)


def _in_container() -> bool:
    return "container" in os.environ or any(mark.exists() for mark in _MARKS_OF_CONTAINERS)


def _user() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return str(os.geteuid())


def _has_capability(number: int) -> bool:
    for line in _STATUS.read_text(encoding="utf-8").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> number & 1)
    return False


# --- the C library ---------------------------------------------------------------------------------------------


def _libc() -> ctypes.CDLL:
    import ctypes  # noqa: PLC0415 - 3 ms of the start that only --realtime has to pay

    return ctypes.CDLL(None, use_errno=True)


def _errno() -> int:
    import ctypes  # noqa: PLC0415 - likewise

    return ctypes.get_errno()
