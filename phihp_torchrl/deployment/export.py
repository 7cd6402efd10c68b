"""Export of an agent's plan or actor as one file, which runs without Python or without torch."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from phihp_torchrl.compilation import compile_ahead
from phihp_torchrl.deployment.export_modules import ExportModule, action_of
from phihp_torchrl.deployment.exported import Act, import_onnx, load_aoti, load_onnx
from phihp_torchrl.deployment.manifest import Manifest


def export_aoti(module: ExportModule, path: str | Path) -> Act:
    """Write a plan or an actor as an AOTInductor package, which C++ and Python can run.

    Args:
        module: the plan or the actor.
        path: the file to write, ending in ``.pt2``; its description goes beside it, as JSON.

    Returns:
        The function in the file, loaded again, of the module's inputs and outputs.

    Examples:
        The export compiles C++ code, which takes about a minute.

        >>> from phihp_torchrl import load_agent
        >>> module = PlanModule(load_agent("results/agents/pendulum"))  # doctest: +SKIP
        >>> act = export_aoti(module, "plan.pt2")  # doctest: +SKIP
        >>> action, plan = act(*module.example())  # doctest: +SKIP
    """
    path = Path(path)
    module.in_loop = True
    try:
        compile_ahead(module, module.example(), path)
    finally:
        module.in_loop = False
    Manifest.of(module, path).write(path)
    return load_aoti(path)


def export_onnx(module: ExportModule, path: str | Path) -> Act:
    """Write a plan or an actor as an ONNX model, which ONNX Runtime can run.

    Args:
        module: the plan or the actor.
        path: the file to write, ending in ``.onnx``; its description goes beside it, as JSON.

    Returns:
        The function in the file, loaded into ONNX Runtime, of the module's inputs and outputs.

    Raises:
        ImportError: if the ``onnx`` extra is not installed.

    Examples:
        This needs the ``onnx`` extra.

        >>> from phihp_torchrl import load_agent
        >>> module = PlanModule(load_agent("results/agents/pendulum"))  # doctest: +SKIP
        >>> act = export_onnx(module, "plan.onnx")  # doctest: +SKIP
        >>> action, plan = act(*module.example())  # doctest: +SKIP
    """
    for name in ("onnxruntime", "onnxscript"):  # torch.onnx needs the second
        import_onnx(name)
    path = Path(path)
    with torch.no_grad():
        program = torch.onnx.export(
            module,
            module.example(),
            input_names=module.input_names,
            output_names=module.output_names,
            dynamo=True,
            verbose=False,
        )
    assert program is not None  # None comes from the older exporter alone
    program.save(str(path))
    Manifest.of(module, path).write(path)
    return load_onnx(path)


def largest_differences(act: Act, module: ExportModule, observations: Tensor) -> Tensor:
    """Return the largest difference of exported and eager actions for each observation, ``[N]``.

    Args:
        act: the exported plan or actor.
        module: the eager one, which gets the same noise and starts an episode as well.
        observations: observations to act on, ``[N, o]``.
    """
    differences = []
    with torch.no_grad():
        for observation in observations:
            given = (observation, *module.draw())
            found, expected = (action_of(each(*given)) for each in (act, module))
            differences.append((found - expected).abs().max())
    return torch.stack(differences)
