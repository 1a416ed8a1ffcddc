"""The names that fdi and rig use, each imported at its first use: numba takes long to load."""

from .compile import (
    ForeignCall as ForeignCall,
    Function as Function,
    bind_later as bind_later,
    compile_function as compile_function,
    find_cache_folder as find_cache_folder,
    find_code_folder as find_code_folder,
    interpret_function as interpret_function,
    keep_apart as keep_apart,
    make_private_folder as make_private_folder,
    raise_unbound as raise_unbound,
    read_normal_tables as read_normal_tables,
)
from .errors import (
    InputError as InputError,
    RigError as RigError,
    count_nouns as count_nouns,
    escape_control_characters as escape_control_characters,
    report_system_error as report_system_error,
    require as require,
    show_value as show_value,
    suggest_name as suggest_name,
)
from .faults import (
    Fault as Fault,
    is_fault_file as is_fault_file,
    place_faults as place_faults,
    read_faults as read_faults,
)
from .forced import compute_flow_balance as compute_flow_balance, compute_force_balance as compute_force_balance
from .foreign import Diverged as Diverged
from .kernels import (
    control_plant as control_plant,
    load_control as load_control,
    load_readings as load_readings,
    pack_state as pack_state,
    store_control as store_control,
    store_readings as store_readings,
    unpack_state as unpack_state,
)
from .lanes import (
    WIDEST as WIDEST,
    Lanes as Lanes,
    Part as Part,
    compile_kernels as compile_kernels,
    list_kernel_variants as list_kernel_variants,
)
from .machine_code import (
    ADVANCE_CALL as ADVANCE_CALL,
    READ_CALL as READ_CALL,
    StoredCode as StoredCode,
    emit_object as emit_object,
    find_function_address as find_function_address,
)
from .model import (
    SHIPPED_MODELS as SHIPPED_MODELS,
    Model as Model,
    build_bare_model as build_bare_model,
    build_kernel as build_kernel,
    find_effect as find_effect,
    find_plant_of_model as find_plant_of_model,
    find_quantity as find_quantity,
    find_shipped_model as find_shipped_model,
    list_searched_effects as list_searched_effects,
    load_model as load_model,
    parse_model as parse_model,
)
from .monitor import FAULTS as FAULTS, Monitor as Monitor
from .parameters import (
    Controller as Controller,
    check_combinations as check_combinations,
    convert_group_unit as convert_group_unit,
    load_nominal_values as load_nominal_values,
    parse_toml as parse_toml,
    parse_value as parse_value,
    read_toml as read_toml,
)
from .pid import Loop as Loop, compute_current as compute_current, control_by_pid as control_by_pid
from .plant_check import (
    MOST_FOLLOWING_ERROR as MOST_FOLLOWING_ERROR,
    check_behaviour as check_behaviour,
    find_divergence as find_divergence,
)
from .plant_files import (
    READERS as READERS,
    read_model_tables as read_model_tables,
    read_named_plant as read_named_plant,
)
from .plants import (
    MODULES as MODULES,
    Plant as Plant,
    Table as Table,
    Term as Term,
    find_key as find_key,
    find_plant as find_plant,
    is_known as is_known,
    is_loaded as is_loaded,
    is_offered as is_offered,
    keep_plant as keep_plant,
    list_plants as list_plants,
    load_plant as load_plant,
)
from .quantity import Quantity as Quantity
from .run import (
    Actuator as Actuator,
    Columns as Columns,
    Demand as Demand,
    compute_answers as compute_answers,
    compute_needed_drive as compute_needed_drive,
    find_compile_error as find_compile_error,
    find_direct_readings as find_direct_readings,
    load_stored_advance as load_stored_advance,
    make_columns_type as make_columns_type,
    report_law_errors as report_law_errors,
    rest_controller as rest_controller,
    sample_noise as sample_noise,
    simulate as simulate,
)
from .segments import (
    LONGEST as LONGEST,
    RATE as RATE,
    Array as Array,
    Csv as Csv,
    Hold as Hold,
    Points as Points,
    Profile as Profile,
    Second as Second,
    Segment as Segment,
    Timed as Timed,
    build_profile as build_profile,
    list_section_names as list_section_names,
    resample_on_cycles as resample_on_cycles,
)
from .selftest import Report as Report, check_effect as check_effect
from .signals import EHA as EHA, Signal as Signal, Signals as Signals
from .solve import (
    read_flat_sensors as read_flat_sensors,
    read_sensors as read_sensors,
    run_closed_loop as run_closed_loop,
    show_start as show_start,
    step_cycle as step_cycle,
    take_demand as take_demand,
)
from .starts import ensure_starts as ensure_starts, lacks_starts as lacks_starts
from .state import Input as Input
from .tables import (
    Choice as Choice,
    Place as Place,
    build_dataclass as build_dataclass,
    decode_text as decode_text,
    list_choices as list_choices,
    parse_table as parse_table,
    quote_text as quote_text,
    read_file as read_file,
)
from .threads import (
    THREAD_NAME as THREAD_NAME,
    count_threads as count_threads,
    map_in_threads as map_in_threads,
    map_together as map_together,
)
from .units import (
    UNITS as UNITS,
    Unit as Unit,
    find_unit as find_unit,
    fit_unit as fit_unit,
    list_fitting_units as list_fitting_units,
    parse_quantity as parse_quantity,
    require_unit as require_unit,
)
from .unpacking import (
    LimitedGzip as LimitedGzip,
    UnpackingError as UnpackingError,
    limit_unpacked_size as limit_unpacked_size,
)
from .user_code import explain_errors as explain_errors, run_file as run_file
