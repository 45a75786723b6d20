"""Tiny networks as ONNX files, for tests of masks."""

from pathlib import Path
from typing import Any

import onnx
from onnx import TensorProto, helper

HALF = 0.5


def constant(name: str, *values: float) -> onnx.TensorProto:
    return helper.make_tensor(
        name, TensorProto.FLOAT, [len(values)] if len(values) > 1 else [], values
    )


def whole(name: str, *values: int) -> onnx.TensorProto:
    return helper.make_tensor(name, TensorProto.INT64, [len(values)], values)


def steps(*nodes: Any, out: Any = (1, 1, "H", "W"), sides: Any = ("H", "W"), **more: Any) -> Any:
    """A model of nodes (operator, inputs, output, attributes) from `x` to `y`."""
    made = [
        helper.make_node(kind, given.split(), [result], **(extra[0] if extra else {}))
        for kind, given, result, *extra in nodes
    ]
    shape = more.get("shape", (1, 3, *sides))
    inputs = [helper.make_tensor_value_info("x", more.get("kind", TensorProto.FLOAT), shape)]
    inputs += [
        helper.make_tensor_value_info(n, TensorProto.FLOAT, [1]) for n in more.get("also", ())
    ]
    kind = more.get("gives", TensorProto.FLOAT)
    outputs = [helper.make_tensor_value_info("y", kind, out)]
    outputs += [helper.make_tensor_value_info(n, kind, None) for n in more.get("besides", ())]
    graph = helper.make_graph(made, "net", inputs, outputs, list(more.get("holds", ())))
    domains = [helper.make_opsetid("", 13), *more.get("domains", ())]
    return helper.make_model(graph, opset_imports=domains, ir_version=8)


MEAN = ("ReduceMean", "x", "mean", {"axes": [1]})
BRIGHT = (MEAN, ("Greater", "mean half", "is"), ("Cast", "is", "y", {"to": TensorProto.FLOAT}))


def brighter_than(level: float, **more: Any) -> Any:
    """1 where the mean of red, green and blue is above a level, else 0."""
    return steps(*BRIGHT, holds=[constant("half", level)], **more)


def written(path: Path, model: Any) -> Path:
    path.write_bytes(model.SerializeToString())
    return path
