"""The names that other folders use, each imported at its first use."""

from .answer import (
    Places as Places,
    choose_file as choose_file,
    choose_places as choose_places,
    give_answer as give_answer,
    make_folder as make_folder,
    name_after as name_after,
    open_console as open_console,
    show_progress as show_progress,
)
from .command_list import (
    LIVE_ON_TERMINAL as LIVE_ON_TERMINAL,
    parse_count as parse_count,
    parse_whole_number as parse_whole_number,
)
from .discovery_inputs import (
    choose_model_file as choose_model_file,
    format_command_line as format_command_line,
    load_known_model as load_known_model,
    split_words as split_words,
)
from .inputs import (
    format_arguments as format_arguments,
    is_suite_file as is_suite_file,
    list_signals as list_signals,
    load_chosen_model as load_chosen_model,
    load_declared_model as load_declared_model,
    load_user_effects as load_user_effects,
    parse_changes as parse_changes,
)
