"""What would leave a mark if a configuration could name any code."""

from pinn_dyn.app.config import CONF


def calls(mark):
    """What would leave the mark, in many ways, each a ``_target_`` with its arguments."""
    touch = f"touch {mark}"
    code = f"open({mark!r}, 'w')"
    return [
        ("os.system", {"command": touch}),
        ("os.popen", {"cmd": touch}),
        ("os.mkdir", {"path": mark}),
        ("os.symlink", {"src": "/", "dst": mark}),
        ("subprocess.run", {"args": ["touch", mark]}),
        ("builtins.exec", {"_args_": [code]}),
        ("builtins.open", {"file": mark, "mode": "w"}),
        ("builtins.__import__", {"name": "antigravity"}),
        ("pathlib.Path.touch", {"self": {"_target_": "pathlib.Path", "_args_": [mark]}}),
        ("shutil.copytree", {"src": str(CONF), "dst": mark}),
        ("shutil.rmtree", {"path": mark}),
        ("runpy.run_path", {"path_name": mark}),
        ("pickle.load", {"file": mark}),
        ("numpy.load", {"file": mark, "allow_pickle": True}),
        ("torch.load", {"f": mark, "weights_only": False}),
        ("torch.hub.load", {"repo_or_dir": mark, "model": "x", "source": "local"}),
        ("torch.optim.os.system", {"command": touch}),
        ("lightning.pytorch.callbacks.os.system", {"command": touch}),
        ("lightning.pytorch.callbacks.LambdaCallback", {"setup": {"_target_": "os.system"}}),
        ("hydra.utils.get_object", {"path": "os.system"}),
        ("hydra.utils.instantiate", {"config": {"_target_": "os.mkdir", "path": mark}}),
        ("functools.partial", {"_args_": ["os.system", touch]}),
        ("importlib.import_module", {"name": "antigravity"}),
        ("pinn_dyn.run.run_folder.write_config", {"folder": mark, "config": {}}),
        ("pinn_dyn.app.command.main", {"command": "train"}),
        ("pinn_dyn.data.cache.os.system", {"command": touch}),
        ("pinn_dyn.data.logs.source.Path.touch", {"self": mark}),
        ("pinn_dyn.evaluation.save", {"figure": 1, "path": mark}),
        ("pinn_dyn.systems.SoftArm.__init__.__globals__", {}),
        (".", {}),
        ("...os.system", {"command": touch}),
        ("os.system\n", {"command": touch}),
        ("${oc.env:HOME}", {}),
        (["os", "system"], {"command": touch}),
        ({"_target_": "os.system"}, {"command": touch}),
        (None, {}),
    ]
