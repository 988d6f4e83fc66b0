"""Hydra's compositions, kept: tests compose the same few choices of groups hundreds of times."""

import copy
import dataclasses
import itertools
import pickle
from pathlib import Path

from hydra._internal import config_loader_impl, defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.defaults_list import Overrides
from hydra.core.object_type import ObjectType
from omegaconf import flag_override

from pinn_dyn.app.config import CONF


def keep_compositions(patch):
    """Compose each choice of groups once; the values of a command line Hydra sets in a copy.

    Files and compositions are kept pickled: a copy of one that way takes a sixth of the time.
    """
    load = ConfigRepository.load_config
    list_defaults = config_loader_impl.create_defaults_list
    compose = ConfigLoaderImpl._compose_config_from_defaults_list
    map_choices = defaults_list._create_interpolation_map
    files, lists, configs = {}, {}, {}

    def kept_file(self, config_path):
        source = self._find_object_source(config_path, ObjectType.CONFIG)
        if source is None or _own_files(source) is not None:
            return load(self, config_path)
        key = (source.provider, source.path, config_path)
        if key not in files:
            files[key] = pickle.dumps(load(self, config_path))
        return pickle.loads(files[key])

    def kept_list(repo, config_name, overrides_list, **how):
        values = Overrides(repo, overrides_list).config_overrides
        groups = [word.input_line for word in overrides_list if word not in values]
        key = (config_name, *groups, *how.items(), *_places(repo))
        if key not in lists:
            lists[key] = list_defaults(repo, config_name, overrides_list, **how)
        return dataclasses.replace(lists[key], config_overrides=values)

    def kept_config(self, defaults, repo):
        key = (*map(dataclasses.astuple, defaults), *_places(repo))
        if key not in configs:
            configs[key] = pickle.dumps(composed(self, defaults, repo))
        return pickle.loads(configs[key])

    def composed(self, defaults, repo):
        # Hydra's own files come first and are mostly the same: ours are merged into those.
        own = list(itertools.dropwhile(_is_hydras, defaults))
        if len(own) in (0, len(defaults)):
            return compose(self, defaults, repo)
        config = kept_config(self, defaults[: -len(own)], repo)
        with flag_override(config, "no_deepcopy_set_nodes", True):
            config.merge_with(compose(self, own, repo))
        return config

    def needed_map(overrides, defaults, self_added):
        # Hydra makes it for every file; those without an interpolation never look at it.
        if any(default.is_interpolation() for default in defaults):
            return map_choices(overrides, defaults, self_added)
        return None

    # Hydra copies all that its plugins stored for each question about a group.
    patch.setattr(ConfigRepository, "__deepcopy__", lambda self, _: copy.copy(self), raising=False)
    patch.setattr(ConfigRepository, "load_config", kept_file)
    patch.setattr(config_loader_impl, "create_defaults_list", kept_list)
    patch.setattr(defaults_list, "_create_interpolation_map", needed_map)
    patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", kept_config)


def _is_hydras(default):
    return default.config_path.startswith("hydra/")


def _places(repo):
    """Where a repository looks, and what is there that may change."""
    return [(source.provider, source.path, _own_files(source)) for source in repo.get_sources()]


def _own_files(source):
    """The files of a test's own folder by name, time and size; None of what stays as it is."""
    if source.scheme() != "file" or source.path.startswith(str(CONF)):
        return None
    found = [(str(path), path.stat()) for path in Path(source.path).rglob("*.y*ml")]
    return tuple(sorted((name, at.st_mtime_ns, at.st_size) for name, at in found))
