"""Arithmetic on torch's tensors or on an agent's graph, so that a law written once is both trained and exported.

A :class:`Value` stands for a result in the graph, shape (n, width); the functions here take tensors or values. Numbers
and tensors that meet a value stand to its right, and become weights of the graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from .export import OnnxGraph


class Value:
    """A result in a graph, by its name."""

    def __init__(self, graph: OnnxGraph, name: str) -> None:
        self.graph, self.name = graph, name

    def node(self, operator: str, *others: Any, **attributes: Any) -> Value:
        """The result of an operator on this value and others."""
        names = [self.name, *map(self._name_of, others)]
        return Value(self.graph, self.graph.node(operator, names, self.graph.unused(operator), **attributes))

    def _name_of(self, other: Any) -> str:
        if isinstance(other, Value):
            return other.name
        if not isinstance(other, torch.Tensor):
            other = np.array(other)
            other = other if other.dtype.kind == "i" else other.astype(np.float32)
        return self.graph.constant(self.graph.unused("weight"), other)

    def __add__(self, other: Any) -> Value:
        return self.node("Add", other)

    def __sub__(self, other: Any) -> Value:
        return self.node("Sub", other)

    def __mul__(self, other: Any) -> Value:
        return self.node("Mul", other)

    def __truediv__(self, other: Any) -> Value:
        return self.node("Div", other)

    def __matmul__(self, other: Any) -> Value:
        return self.node("MatMul", other)


def concat(parts: Sequence[Any]) -> Any:
    """Concatenation along the last axis."""
    first = parts[0]
    return first.node("Concat", *parts[1:], axis=1) if isinstance(first, Value) else torch.cat(list(parts), dim=-1)


def columns(x: Any, at: Sequence[int]) -> Any:
    """Some columns, by their places; a range is one of neighbours."""
    if isinstance(x, Value):
        return x.node("Gather", list(at), axis=1)
    return x[..., at.start : at.stop] if isinstance(at, range) else x[..., list(at)]


def split(x: Any, widths: Sequence[int]) -> list[Any]:
    """Neighbouring columns, split into these widths."""
    ends = np.cumsum(widths).tolist()
    return [columns(x, range(end - width, end)) for width, end in zip(widths, ends, strict=True)]


def relu(x: Any) -> Any:
    """The positive part."""
    return x.node("Relu") if isinstance(x, Value) else torch.relu(x)


def root(x: Any) -> Any:
    """The square root."""
    return x.node("Sqrt") if isinstance(x, Value) else torch.sqrt(x)


def clamp(x: Any, low: float, high: float) -> Any:
    """x clamped to [low, high]."""
    if isinstance(x, Value):
        return x.node("Clip", np.float32(low), np.float32(high))
    return torch.clamp(x, low, high)


def apply(x: Any, module: nn.Module) -> Any:
    """A module of torch, applied to x."""
    return Value(x.graph, x.graph.apply(x.name, [module])) if isinstance(x, Value) else module(x)
