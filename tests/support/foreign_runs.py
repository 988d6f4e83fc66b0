"""Run folders that somebody has changed."""

import copy
import shutil

import torch
import yaml


def foreign(run, folder, change):
    """A copy of a run whose configuration somebody has changed; its checkpoint says the same."""
    shutil.copytree(run, folder)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    change(config)
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    for name in ("best", "last"):
        path = folder / "checkpoints" / f"{name}.ckpt"
        saved = torch.load(path, weights_only=True)
        saved["hyper_parameters"]["config"] = copy.deepcopy(config)
        torch.save(saved, path)
    return folder
