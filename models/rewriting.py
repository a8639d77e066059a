"""Graphs of convolutional networks in the order in which a processor is fastest: the same weights, the same function.

What a graph of torch computes of each picture is computed of the weights instead, by nodes that ONNX Runtime folds into constants
when it loads the file: so the weights in the file stay those that were trained. A normalisation becomes part of the convolution
before it. A convolution of 3 x 3 over nearest neighbours at twice the size sees each element several times: each element of a
square of four has a kernel of 2 x 2 of its own, sums of the 3 x 3 (docs/adr/0044).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from onnx import helper, numpy_helper

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
        """The node of a kind that makes a tensor which nothing else uses; None where there is no such."""
        node = self.producer.get(name)
        return node if node is not None and node.op_type == kind and len(self.users[name]) == 1 else None

    def fold_normalisation(self, node: Any) -> bool:
        """Weights and bias of the convolution before a normalisation, times and less what this is of each channel."""
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
        """The convolution of 3 x 3 of what was enlarged beside something else, and what only each element decides after it."""
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
            beside = self._add("Conv", inputs, f"{name}_skip", pads=pads, kernel_shape=[3, 3], strides=[2, 2])
            phase = self._add("Relu", [self._add("Add", [beside, low], f"{name}_sum")], name)
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
        """Of what a convolution, possibly followed by a `Relu`, gives, or one that was split already."""
        while (node := self.producer[name]).op_type != "Conv":
            name = node.input[0]
        return self.shapes[node.input[1]][0]

    def _find_last(self, name: str) -> Any:
        """The convolution of 1 x 1 that alone uses a tensor; None where there is none."""
        users = self.users[name]
        if len(users) != 1 or users[0].op_type != "Conv" or self.shapes[users[0].input[1]][2:] != (1, 1):
            return None
        return users[0]

    def write_exponentials(self, node: Any) -> bool:
        """Softmax over channels: the runtime's own turns the tensor for it, and back."""
        if node.op_type != "Softmax" or [a.i for a in node.attribute if a.name == "axis"] != [1]:
            return False
        (x,), out = node.input, node.output[0]
        axis = self._add_weight("channels", np.array([1]))
        most = self._add("ReduceMax", [x, axis], f"{out}_most")
        power = self._add("Exp", [self._add("Sub", [x, most], f"{out}_less")], f"{out}_power")
        self._add("Div", [power, self._add("ReduceSum", [power, axis], f"{out}_total")], out)
        return True
