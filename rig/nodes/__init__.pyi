"""The names that other folders use, each imported at its first use."""

from .called_loop import (
    call_loop as call_loop,
    load_loop as load_loop,
    make_port as make_port,
)
from .emulator import (
    Emulator as Emulator,
    find_plant_node as find_plant_node,
    list_unheard as list_unheard,
)
from .emulator_cycle import (
    CURRENT_ZEROED as CURRENT_ZEROED,
    DRIVE_LATE as DRIVE_LATE,
    DRIVE_MISSING as DRIVE_MISSING,
    FEEDBACK_FRAME as FEEDBACK_FRAME,
    IN_FORCE as IN_FORCE,
    READINGS_AT as READINGS_AT,
    SENSORS as SENSORS,
    Memory as Memory,
    advance_plant as advance_plant,
    fill_noise as fill_noise,
    find_action as find_action,
    find_drive_action as find_drive_action,
    make_memory as make_memory,
    read_plant as read_plant,
)
from .emulator_service import EmulatorService as EmulatorService
from .firmware import (
    Firmware as Firmware,
    StandIn as StandIn,
)
from .plant_code import (
    CompiledPlant as CompiledPlant,
    load_plant as load_plant,
)
from .scenario import Scenario as Scenario
