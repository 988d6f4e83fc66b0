"""Hydra's compositions, kept: tests compose the same few choices of groups hundreds of times."""

import copy
import dataclasses

from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.defaults_list import Overrides

from pinn_dyn.app.config import CONF


def keep_compositions(patch):
    """Compose each choice of groups once; the values of a command line Hydra sets in a copy."""
    list_defaults = config_loader_impl.create_defaults_list
    compose = ConfigLoaderImpl._compose_config_from_defaults_list
    lists, configs = {}, {}

    def kept_list(repo, config_name, overrides_list, **how):
        if not _is_ours(repo):
            return list_defaults(repo, config_name, overrides_list, **how)
        values = Overrides(repo, overrides_list).config_overrides
        groups = [word.input_line for word in overrides_list if word not in values]
        key = (config_name, *groups, *how.items(), str(repo.get_sources()))
        if key not in lists:
            lists[key] = list_defaults(repo, config_name, overrides_list, **how)
        return dataclasses.replace(lists[key], config_overrides=values)

    def kept_config(self, defaults, repo):
        if not _is_ours(repo):
            return compose(self, defaults, repo)
        key = (*map(dataclasses.astuple, defaults), str(repo.get_sources()))
        if key not in configs:
            configs[key] = compose(self, defaults, repo)
        return copy.deepcopy(configs[key])

    # Hydra copies all that its plugins stored for each question about a group.
    patch.setattr(ConfigRepository, "__deepcopy__", lambda self, _: copy.copy(self), raising=False)
    patch.setattr(config_loader_impl, "create_defaults_list", kept_list)
    patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", kept_config)


def _is_ours(repo):
    """Whether all files are those of the package: a test may change others."""
    folders = [source.path for source in repo.get_sources() if source.scheme() == "file"]
    return all(path.startswith(str(CONF)) for path in folders)
