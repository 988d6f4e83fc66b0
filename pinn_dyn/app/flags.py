"""The flags of a command line, which are Hydra's: where they stand, and which go together."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

from hydra._internal.utils import get_args_parser

from pinn_dyn.app.schema import ConfigError
from pinn_dyn.app.words import OVERRIDE

_COMPLETION = ("install", "uninstall", "query")


def in_order(command: str, arguments: list[str]) -> list[str]:
    """The words of a command line with its flags first, which argparse takes in no other order.

    Raises:
        ConfigError: on a flag that does not exist, lacks its value, or does not go with another; a
            word that is neither a flag nor an override.
    """
    parser = get_args_parser()
    parser.prog = f"{command}.py"
    parser.error = _refuse  # type: ignore[method-assign,assignment]
    given = parser.parse_intermixed_args(arguments)
    flags = list(arguments)
    for word in given.overrides:
        flags.remove(word)
    if given.shell_completion:  # whose words are no overrides
        if not given.overrides or given.overrides[0].split("=")[0] not in _COMPLETION:
            raise ConfigError(
                f"--shell-completion lacks one of {', '.join(_COMPLETION)}, as install=bash"
            )
        return arguments
    for word in given.overrides:
        if not OVERRIDE.match(word):
            raise ConfigError(
                f"'{word}' is no override, expected key=value, as seed=1, or ~key: see "
                f"python {command}.py --help"
            )
    modes = ("run", "multirun", "cfg", "info")
    if len(both := [f"--{mode}" for mode in modes if getattr(given, mode)]) > 1:
        raise ConfigError(f"{' and '.join(both)} do not go together: give one of them")
    for flag in ("resolve", "package"):
        if getattr(given, flag) and not (given.cfg or given.help):
            raise ConfigError(f"--{flag} belongs to --cfg, which prints: give --cfg job with it")
    if given.config_name not in (None, command):
        raise ConfigError(
            f"--config-name is {given.config_name}, expected none, as {command}.py has its own: "
            "choose an option of a group, as experiment=... or dataset=..."
        )
    if given.config_path:
        raise ConfigError(
            f"--config-path is {given.config_path}, expected none, as it would replace all groups: "
            "add groups of your own by --config-dir=<folder>"
        )
    if given.config_dir and not Path(given.config_dir).is_dir():
        raise ConfigError(
            f"--config-dir is {given.config_dir}, expected a folder with groups, as "
            "my_conf with a file my_conf/dataset/arm.yaml"
        )
    if given.experimental_rerun:
        raise ConfigError(
            "--experimental-rerun reads a pickle, which may run code: use resume=<run>"
        )
    return [*flags, *given.overrides]


def _refuse(said: str) -> NoReturn:
    """What argparse cannot read, without its page of usage."""
    if said.startswith("unrecognized arguments"):
        said += ". A key has no dashes, as seed=1; flags are --help, --cfg job, --multirun (-m)"
    raise ConfigError(f"the command line has {said}, and --hydra-help lists all flags")
