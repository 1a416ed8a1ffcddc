"""The names that other folders use, each imported at its first use."""

from .bring_up import open_loop as open_loop
from .frame_steps import find_visible_steps as find_visible_steps
from .hard_loop import compile_cycle as compile_cycle
from .job import (
    Job as Job,
    JobChoice as JobChoice,
    build_job as build_job,
    find_differences as find_differences,
    load_plant_of_log as load_plant_of_log,
    load_tested_plant as load_tested_plant,
    load_tested_sequence as load_tested_sequence,
    read_job as read_job,
    replace_settings as replace_settings,
    speaks_as_shipped as speaks_as_shipped,
)
from .loop import (
    CycleInput as CycleInput,
    History as History,
)
from .participants import (
    EMBEDDED_NAMES as EMBEDDED_NAMES,
    NodeProcesses as NodeProcesses,
    is_replaced as is_replaced,
    make_node_command as make_node_command,
    require_firmware_bus as require_firmware_bus,
)
from .priority import (
    LOOP_PRIORITY as LOOP_PRIORITY,
    compute_percentiles as compute_percentiles,
    enter_loop_thread as enter_loop_thread,
    enter_real_time as enter_real_time,
    list_cpus as list_cpus,
    lock_memory as lock_memory,
    raise_priority as raise_priority,
)
from .runner import (
    INTERRUPTED as INTERRUPTED,
    LimitReached as LimitReached,
    Outcome as Outcome,
    attribute_run as attribute_run,
    describe_faults as describe_faults,
    describe_finding as describe_finding,
    diagnose_run as diagnose_run,
    find_limits as find_limits,
    has_fault as has_fault,
    judge_run as judge_run,
    open_recorder as open_recorder,
    run_job as run_job,
)
from .session import Session as Session
