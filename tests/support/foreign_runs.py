"""Run folders that somebody has changed."""

import copy
import functools
import io
import shutil

import torch
import yaml

# By libyaml where it is there: in a tenth of the time.
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@functools.cache
def loaded(checkpoint):
    """What the bytes of a checkpoint hold: most tests change the same run."""
    return torch.load(io.BytesIO(checkpoint), weights_only=True)


def foreign(run, folder, change):
    """A copy of a run whose configuration somebody has changed; its checkpoint says the same."""
    shutil.copytree(run, folder)
    config = yaml.load((folder / "config.yaml").read_text(), LOADER)
    change(config)
    (folder / "config.yaml").write_text(yaml.dump(config, Dumper=DUMPER, sort_keys=False))
    for name in ("best", "last"):
        path = folder / "checkpoints" / f"{name}.ckpt"
        saved = loaded(path.read_bytes())
        changed = saved["hyper_parameters"] | {"config": copy.deepcopy(config)}
        torch.save(saved | {"hyper_parameters": changed}, path)
    return folder
