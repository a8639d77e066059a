"""Networks of torch as ONNX files (`topomerge.networks` runs them), and as what the package calls before they are exported."""

from __future__ import annotations

import logging
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from onnx import helper, numpy_helper
from topomerge.models.embedder import Embedder
from torch import Tensor, nn

import topomerge
from topomerge.archive import replace_on_success
from topomerge.embedding.learned import EMBEDDER_FILE, build_card
from topomerge.embedding.network import build_embedder_signature
from topomerge.errors import InputError
from topomerge.networks.network import Run, Signature, write_card
from topomerge.types import Array

PHASES = ((0, 0), (0, 1), (1, 0), (1, 1))  # elements of a square, in the order of DepthToSpace
TAPS = np.array([[[1, 0, 0], [0, 1, 1]], [[1, 1, 0], [0, 0, 1]]], np.float32)  # of 3, that fall on the same element, by phase


def rewrite_graph(graph: Any) -> None:
    """Rewrite a `GraphProto` in place: what it gives differs by what rounding does to sums in another order."""
    rewriter = GraphRewriter(graph)
    for step in (rewriter.fold_normalisation, rewriter.split_enlarged, rewriter.write_exponentials):
        rewriter.remove_unused()
        rewriter.replace_nodes(step)
    rewriter.remove_unused()


class GraphRewriter:
    """Steps of `rewrite_graph`: each is offered a node, adds those that stand for it, and tells whether it did.

    Args:
        graph: a `GraphProto`.
    """

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.nodes: list[Any] = []  # that came, each before what uses it
        self.done: set[str] = set()  # outputs of nodes that others stand for
        self.constants = {node.output[0]: node.attribute[0] for node in graph.node if node.op_type == "Constant"}
        self.shapes = {weight.name: tuple(weight.dims) for weight in graph.initializer}

    def remove_unused(self) -> None:
        """Remove nodes and weights that no output depends on."""
        used = {output.name for output in self.graph.output}
        kept = []
        for node in reversed(self.graph.node):
            if used.intersection(node.output):
                used.update(node.input)
                kept.append(node)
        weights = [weight for weight in self.graph.initializer if weight.name in used]
        for field, values in ((self.graph.node, kept[::-1]), (self.graph.initializer, weights)):
            del field[:]
            field.extend(values)

    def replace_nodes(self, step: Callable[[Any], bool]) -> None:
        """Offer each node to a step."""
        nodes = list(self.graph.node)
        self.producer: dict[str, Any] = {name: node for node in nodes for name in node.output}
        self.users: dict[str, list[Any]] = defaultdict(list)
        for node in nodes:
            for name in node.input:
                self.users[name].append(node)
        self.nodes, self.done = [], set()
        for node in nodes:
            if node.output[0] not in self.done and not step(node):
                self.nodes.append(node)
        del self.graph.node[:]
        self.graph.node.extend(self.nodes)

    def _add(self, kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(kind, list(inputs), [output], name=output, **attributes))
        return output

    def _add_weight(self, name: str, values: Any) -> str:
        if name not in self.shapes:
            self.graph.initializer.append(numpy_helper.from_array(np.asarray(values), name))
            self.shapes[name] = np.shape(values)
        return name

    def _find_source(self, name: str, kind: str) -> Any:
        """Return the node of a kind that makes a tensor which nothing else uses; None where there is no such."""
        node = self.producer.get(name)
        return node if node is not None and node.op_type == kind and len(self.users[name]) == 1 else None

    def fold_normalisation(self, node: Any) -> bool:
        """Fold a normalisation into the weights and the bias of the convolution before it, times and less what this is of each
        channel."""
        conv = self._find_source(node.input[0], "Conv") if node.op_type == "BatchNormalization" else None
        if conv is None or conv.input[1] not in self.shapes or len(conv.input) < 3 or conv.input[2] in self.shapes:
            return False  # a bias of the convolution's own would have to be weighed, too
        gain, offset, mean, variance = node.input[1:5]
        (epsilon,) = (a.f for a in node.attribute if a.name == "epsilon")
        out, rank = node.output[0], len(self.shapes[conv.input[1]])
        small = self._add_weight(f"epsilon_{epsilon:.0e}", np.float32(epsilon))
        each = self._add_weight(f"each_of_{rank}", np.array([-1, *[1] * (rank - 1)]))
        spread = self._add("Sqrt", [self._add("Add", [variance, small], f"{out}_variance")], f"{out}_spread")
        scale = self._add("Div", [gain, spread], f"{out}_scale")
        weight = self._add("Mul", [conv.input[1], self._add("Reshape", [scale, each], f"{out}_scales")], f"{out}_weight")
        bias = self._add("Sub", [offset, self._add("Mul", [mean, scale], f"{out}_mean")], f"{out}_bias")
        self.shapes[weight] = self.shapes[conv.input[1]]
        self.nodes.append(helper.make_node("Conv", [conv.input[0], weight, bias], [out], name=f"{out}_conv"))
        self.nodes[-1].attribute.extend(conv.attribute)
        return True

    def split_enlarged(self, node: Any) -> bool:
        """Split the convolution of 3 x 3 of what was enlarged beside something else, and what only each element decides after
        it."""
        joined = self._find_source(node.input[0], "Concat") if node.op_type == "Conv" else None
        if joined is None or len(joined.input) != 2:
            return False
        enlarged = self._find_source(joined.input[0], "Resize")
        if (
            enlarged is None
            or list(self.constants[enlarged.input[2]].floats) != [1, 1, 2, 2]
            or len(self.users[node.output[0]]) != 1
        ):
            return False
        (relu,) = self.users[node.output[0]]
        (x, _, _), skip, out = enlarged.input, joined.input[1], relu.output[0]
        assert relu.op_type == "Relu" and self.shapes[node.input[1]][2:] == (3, 3)
        wide = self._count_channels(x)
        sizes = self._add_weight(f"{out}_widths", np.array([wide, self.shapes[node.input[1]][1] - wide]))
        self.nodes.append(helper.make_node("Split", [node.input[1], sizes], [f"{out}_of_low", f"{out}_of_skip"], axis=1))
        last = self._find_last(out)
        phases = []
        for p, q in PHASES:
            name, pads = f"{out}_{p}{q}", [1 - p, 1 - q, p, q]
            rows, columns = (self._add_weight(f"taps_{k}", taps) for k, taps in ((p, TAPS[p]), (f"{q}_across", TAPS[q].T)))
            kernel = self._add("MatMul", [rows, f"{out}_of_low"], f"{name}_rows")
            kernel = self._add("MatMul", [kernel, columns], f"{name}_kernel")
            low = self._add("Conv", [x, kernel], f"{name}_low", pads=pads, kernel_shape=[2, 2])
            inputs = [skip, f"{out}_of_skip", node.input[2]]
            own = self._add("Conv", inputs, f"{name}_skip", pads=pads, kernel_shape=[3, 3], strides=[2, 2])
            phase = self._add("Relu", [self._add("Add", [own, low], f"{name}_sum")], name)
            phases.append(
                phase if last is None else self._add("Conv", [phase, *last.input[1:]], f"{name}_last", kernel_shape=[1, 1])
            )
        end = relu if last is None else last
        squares = self._add("Concat", phases, f"{out}_squares", axis=1)
        self._add("DepthToSpace", [squares], end.output[0], blocksize=2, mode="DCR")
        for done in (relu, last):
            if done is not None:
                self.done.add(done.output[0])
        return True

    def _count_channels(self, name: str) -> int:
        """Count the channels of what a convolution, possibly followed by a `Relu`, gives, or one that was split already."""
        while (node := self.producer[name]).op_type != "Conv":
            name = node.input[0]
        return self.shapes[node.input[1]][0]

    def _find_last(self, name: str) -> Any:
        """Return the convolution of 1 x 1 that alone uses a tensor; None where there is none."""
        users = self.users[name]
        if len(users) != 1 or users[0].op_type != "Conv" or self.shapes[users[0].input[1]][2:] != (1, 1):
            return None
        return users[0]

    def write_exponentials(self, node: Any) -> bool:
        """Write the softmax over channels by exponentials: the runtime's own turns the tensor for it, and back."""
        if node.op_type != "Softmax" or [a.i for a in node.attribute if a.name == "axis"] != [1]:
            return False
        (x,), out = node.input, node.output[0]
        axis = self._add_weight("channels", np.array([1]))
        most = self._add("ReduceMax", [x, axis], f"{out}_most")
        power = self._add("Exp", [self._add("Sub", [x, most], f"{out}_less")], f"{out}_power")
        self._add("Div", [power, self._add("ReduceSum", [power, axis], f"{out}_total")], out)
        return True


ONNX_OPSET = 18


def export_network(module: nn.Module, signature: Signature, sample: Sequence[Tensor], path: str | Path) -> None:
    """Write a network; the same weights give the same bytes.

    Args:
        module: its arguments are the inputs of the signature, in order; it returns the outputs, in order.
        sample: inputs that the graph is traced with; sizes with names must be 2 or more there.

    Raises:
        InputError: onnx is not installed, a weight is no finite number, or the path can't be written.
    """
    check_exporter()
    if not all(torch.isfinite(value).all() for value in module.state_dict().values()):
        raise InputError(f"{path}: weights are no finite numbers; training diverged, take another run")
    for name in ("torch.onnx", "onnxscript", "onnx_ir"):  # Hydra shows what any library tells
        logging.getLogger(name).setLevel(logging.ERROR)
    with warnings.catch_warnings(), replace_on_success(path) as temporary:
        warnings.simplefilter("ignore")
        if isinstance(module, Branches):
            model = _joined([_traced(branch, signature, sample, 1) for branch in module.branches], next(iter(signature.inputs)))
        else:
            from topomerge.models.export import rewrite_graph  # which imports onnx

            model = _traced(module, signature, sample)
            rewrite_graph(model.graph)
        temporary.write_bytes(model.SerializeToString(deterministic=True))


def load_exported_weights(module: nn.Module, path: str | Path) -> None:
    """Load the weights of a file that `export_network` wrote of such a module.

    Raises:
        InputError: no such file, not onnx, or the weights of another network.
    """
    check_exporter()
    import onnx

    try:
        graph = onnx.load(str(path)).graph
    except Exception as error:  # onnx and protobuf have kinds of their own
        raise InputError(f"{path}: can't be read as ONNX ({' '.join(str(error).split())[:80]})") from error
    stored = {one.name.partition(".")[2]: one for one in graph.initializer}  # below `_Positional.network`
    weights = module.state_dict()
    needed = {name: tuple(value.shape) for name, value in weights.items() if not name.endswith("num_batches_tracked")}
    differs = [name for name, shape in needed.items() if name not in stored or tuple(stored[name].dims) != shape]
    if differs:
        raise InputError(f"{path}: is another network than these settings make ({len(differs)} weights differ, as {differs[0]})")
    with torch.no_grad():
        for name in needed:
            weights[name].copy_(torch.tensor(onnx.numpy_helper.to_array(stored[name])))


def check_exporter() -> None:
    """Refuse to train what could not be exported.

    Raises:
        InputError: onnx is not installed.
    """
    if not all(map(find_spec, ("onnx", "onnxscript"))):
        raise InputError("ONNX needs onnx and onnxscript: pip install topomerge[learn]")


def _traced(module: nn.Module, signature: Signature, sample: Sequence[Tensor], start: int = 0) -> Any:
    """Return the ONNX model of a network whose inputs are those of the signature from `start` on."""
    inputs = dict(list(signature.inputs.items())[start:])
    shapes = tuple(
        {axis: torch.export.Dim.DYNAMIC for axis, size in enumerate(tensor.shape) if isinstance(size, str)}
        for tensor in inputs.values()
    )
    program = torch.onnx.export(
        _Positional(module.eval()), tuple(sample[start:]), dynamo=True, opset_version=ONNX_OPSET, verbose=False, optimize=False,
        input_names=list(inputs), output_names=list(signature.outputs), dynamic_shapes=(shapes,),
    )  # fmt: skip
    assert program is not None
    model = program.model_proto
    _count_axes_from_front(model.graph)
    _strip(model.graph)
    for function in model.functions:
        _strip(function)
    return model


def _joined(models: Sequence[Any], choice: str) -> Any:
    """Join models of the same inputs and outputs: of them runs which an input names by a 1. Weights stand in it once."""
    from onnx import TensorProto, compose, helper

    weights = {w.name: w for model in models for w in model.graph.initializer}
    outputs = [output.name for output in models[0].graph.output]
    branches = []
    for k, model in enumerate(models):
        of_branch = compose.add_prefix_graph(model.graph, f"{k}/", rename_inputs=False, rename_initializers=False)
        del of_branch.input[:], of_branch.initializer[:]
        branches.append(of_branch)
    joined = helper.make_model(
        helper.make_graph([], "branches", list(models[0].graph.input), list(models[0].graph.output), list(weights.values())),
        opset_imports=models[0].opset_import, ir_version=models[0].ir_version, functions=models[0].functions,
    )  # fmt: skip
    joined.graph.input.insert(0, helper.make_tensor_value_info(choice, TensorProto.INT64, [len(models)]))
    chosen = branches[-1]
    for k in reversed(range(len(models) - 1)):
        index = helper.make_tensor(f"index_{k}", TensorProto.INT64, [1], [k])
        joined.graph.initializer.append(index)
        names = outputs if k == 0 else [f"from_{k}/{name}" for name in outputs]
        nodes = [
            helper.make_node("Gather", [choice, index.name], [f"one_{k}"]),
            helper.make_node("Cast", [f"one_{k}"], [f"is_{k}"], to=TensorProto.BOOL),
            helper.make_node("If", [f"is_{k}"], names, then_branch=branches[k], else_branch=chosen),
        ]
        values = [helper.make_value_info(name, output.type) for name, output in zip(names, models[0].graph.output, strict=True)]
        chosen = helper.make_graph(nodes, f"from_{k}", [], values)
    joined.graph.node.extend(chosen.node)
    return joined


def _count_axes_from_front(graph: Any) -> None:
    """Name the axes of sums and the like from the front: ONNX Runtime 1.31 mistakes those from the end in empty tensors."""
    from onnx import helper, numpy_helper

    ranks = {value.name: len(value.type.tensor_type.shape.dim) for value in (*graph.value_info, *graph.input)}
    constants = {node.output[0]: node.attribute[0] for node in graph.node if node.op_type == "Constant"}
    nodes = []
    for node in graph.node:
        if node.op_type.startswith("Reduce") and len(node.input) > 1 and node.input[0] in ranks and node.input[1] in constants:
            given = constants[node.input[1]]
            axes = np.array(given.ints) if given.name == "value_ints" else numpy_helper.to_array(given.t).reshape(-1)
            node.input[1] = f"{node.output[0]}_axes"
            nodes.append(helper.make_node("Constant", [], [node.input[1]], value_ints=(axes % ranks[node.input[0]]).tolist()))
        nodes.append(node)
    del graph.node[:]
    graph.node.extend(nodes)


def _strip(graph: Any) -> None:
    """Remove what tells of the machine: stack traces with paths of files."""
    del graph.metadata_props[:]
    for node in (*graph.node, *getattr(graph, "input", ()), *getattr(graph, "output", ()), *getattr(graph, "initializer", ())):
        if hasattr(node, "metadata_props"):
            del node.metadata_props[:]
    del graph.value_info[:]


def build_sample(signature: Signature) -> list[Tensor]:
    """Build random inputs of a signature, in which sizes of different names differ."""
    names = sorted({size for tensor in signature.inputs.values() for size in tensor.shape if isinstance(size, str)})
    sizes = {name: 5 + 2 * k for k, name in enumerate(names)}
    shapes = [[sizes[n] if isinstance(n, str) else n for n in t.shape] for t in signature.inputs.values()]
    dtypes = [getattr(torch, t.dtype) for t in signature.inputs.values()]
    return [torch.rand(shape).to(dtype) for shape, dtype in zip(shapes, dtypes, strict=True)]


def build_embedder_sample(
    network: Embedder, rooms: int = 6, edges: int = 10, pairs: int = 12, seed: int = 0
) -> dict[str, Tensor]:
    """Build random tensors of a map, of the shapes that an embedder reads."""
    generator, sizes = torch.Generator().manual_seed(seed), {"rooms": rooms, "edges": edges, "pairs": pairs}
    sample = {}
    for name, tensor in build_embedder_signature(network.network).inputs.items():
        shape = [sizes[n] if isinstance(n, str) else n for n in tensor.shape]
        if tensor.dtype == "int64":
            sample[name] = torch.randint(0, max(rooms if name == "edge_index" else edges, 1), shape, generator=generator)
        else:
            values = torch.rand(shape, generator=generator) * 3
            sample[name] = (80 * values).to(torch.uint8) if tensor.dtype == "uint8" else values
    return sample


def export_embedder(network: Embedder, folder: str | Path, about: Mapping[str, Any] | None = None) -> Path:
    """Write an embedder and its card into a folder, which is made if need be; the network, on the processor, is not changed.

    Args:
        about: on what it was trained, how good it is.

    Raises:
        InputError: as `export_network`.
    """
    path = Path(folder) / EMBEDDER_FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be written ({error.strerror or error})") from error
    sample = list(build_embedder_sample(network).values())
    export_network(Ordered(network), build_embedder_signature(network.network), sample, path)
    card = build_card(network.network, float(network.temperature.detach()), about)
    write_card(path, {**card, "version": topomerge.__version__})
    return path


def run_with_torch(module: nn.Module, signature: Signature) -> Run:
    """Run a network as `topomerge.networks.network.Network` would: training is scored with it before anything is exported."""

    @torch.no_grad()
    def run(outputs: Sequence[str] | None = None, /, **inputs: Array) -> list[Array]:
        module.eval()
        device = next(module.parameters()).device
        # Copies: of a map with one room, views of its table count as contiguous with steps that torch refuses.
        feeds = (torch.from_numpy(np.array(inputs[n], t.dtype, order="C")).to(device) for n, t in signature.inputs.items())
        computed = module(*feeds)
        arrays = [t.cpu().numpy() for t in (computed if isinstance(computed, Sequence) else (computed,))]
        named = dict(zip(signature.outputs, arrays, strict=True))
        return list(named.values()) if outputs is None else [named[name] for name in outputs]

    return run


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Return the weights of an exported network by their names in the module: what a training goes on with."""
    import onnx

    model = onnx.load(str(path), load_external_data=False)
    prefix = "network."
    arrays = {i.name: onnx.numpy_helper.to_array(i) for i in model.graph.initializer}
    return {n.removeprefix(prefix): torch.from_numpy(a.copy()) for n, a in arrays.items() if n.startswith(prefix)}


class Branches(nn.Module):
    """Networks of the same inputs and outputs, of which a call runs one: that which its first input, an int64, has a 1 for."""

    def __init__(self, branches: Iterable[nn.Module]) -> None:
        super().__init__()
        self.branches = nn.ModuleList(branches)

    def forward(self, choice: Tensor, *inputs: Tensor) -> Sequence[Tensor]:
        """Run the one."""
        outputs: Sequence[Tensor] = self.branches[int(choice.argmax())](*inputs)
        return outputs


class Ordered(nn.Module):
    """An embedder that takes its tensors in order."""

    def __init__(self, network: Embedder) -> None:
        super().__init__()
        self.network = network

    def forward(self, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        """Return rows and dustbins."""
        outputs: tuple[Tensor, Tensor] = self.network(dict(zip(self.network.tensors, tensors, strict=True)))
        return outputs


class _Positional(nn.Module):
    """A network whose inputs come as a tuple, whatever their number."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *tensors: Tensor) -> Tensor | Sequence[Tensor]:
        outputs: Tensor | Sequence[Tensor] = self.network(*tensors)
        return outputs
