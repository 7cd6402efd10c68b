"""Settings: how they are read and checked, the methods that use them, and their YAML files.

Nothing in this folder imports torch, so that settings can be read and printed without delay.
"""

from __future__ import annotations

from phihp_torchrl.config.checks import (
    LARGEST_FLOAT32,
    check_choice,
    check_count,
    check_memory,
    check_not_negative,
    check_positive,
    check_positive_share,
    check_share,
    check_widths,
    is_whole,
)
from phihp_torchrl.config.choices import YAML, offer, publish_offers
from phihp_torchrl.config.compose import (
    MODULE,
    PLACES,
    apply_overrides,
    compose_yaml,
    finish,
    load_config,
)
from phihp_torchrl.config.convert import INFINITE, check_fields, plain, plain_fields
from phihp_torchrl.config.durations import (
    Discount,
    Steps,
    check_discount,
    check_steps,
    discount_of,
    in_seconds,
    parse_seconds,
    refuse_seconds,
    resolve_seconds,
    steps_in,
)
from phihp_torchrl.config.errors import ConfigError, meant
from phihp_torchrl.config.help import help_text, sentences, sentences_of, settings_text
from phihp_torchrl.config.methods import METHODS, Method, get_method, register_method
from phihp_torchrl.config.modules import import_named
from phihp_torchrl.config.overrides import (
    open_mappings,
    override_key,
    override_lines,
    parse_overrides,
)
from phihp_torchrl.config.own_key import STATE_VARIABLE, is_own_signature, own_signature
from phihp_torchrl.config.registry import Registry
from phihp_torchrl.config.seals import (
    DIGEST,
    check_seal,
    digest_of,
    digest_of_values,
    sealed,
    unsealed,
)
from phihp_torchrl.config.system_errors import file_error, names_file
from phihp_torchrl.config.typed import (
    default_of,
    differences,
    flatten,
    from_mapping,
    kind_mapping,
    read_kind,
    to_mapping,
)

__all__ = [
    "ConfigError",
    "Method",
    "get_method",
    "load_config",
    "register_method",
    "resolve_seconds",
]
