"""An LSTM layer for training on processors: PyTorch's mathematics and weights, with the gradient written out.

Four things make it quicker than `nn.LSTM` there, in which a step of training spends most of its time: what a tick is
given (inputs, a row of ones for the biases, and the state) stands together, so that a tick is one product of matrices
forward and two backward; features are rows and samples columns, so that every gate is one stretch of memory; tanh(a) is
taken as 2 sigmoid(2a) - 1, which is vectorised better; and an input that is the same at every tick is multiplied once.
For one thread: many small steps are not worth sharing, and on a GPU nn.LSTM is one kernel.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import Function

_aten = torch.ops.aten


def last_state(lstm: nn.LSTM, inputs: Tensor) -> Tensor:
    """(N, H) the state after the last tick, from zero, as `nn.LSTM` gives it.

    Args:
        lstm: one layer; its weights are read, it is not called.
        inputs: (T, I + 1, N) I inputs at each of T ticks, and a row of ones.
    """
    of_input, of_state, bias = _weights(lstm)
    return _run(inputs, torch.cat([of_input, bias, of_state], dim=1), None, last=True).t()


def unroll(lstm: nn.LSTM, given: Tensor, ticks: int) -> Tensor:
    """(T, H, N) the state after each tick, from zero, where the same (N, I) is given at every tick.

    Args:
        lstm: one layer; its weights are read, it is not called.
        given: (N, I).
        ticks: T.
    """
    of_input, of_state, bias = _weights(lstm)
    shared = torch.addmm(bias, of_input, given.t())  # (4H, N)
    return _run(given.new_empty(ticks, 0, len(given)), of_state, shared, last=False)


def _weights(lstm: nn.LSTM) -> tuple[Tensor, Tensor, Tensor]:
    """(4H, I) of the input, (4H, H) of the state, and the (4H, 1) sum of both biases."""
    of_input, of_state, bias, other_bias = lstm.all_weights[0]
    return of_input, of_state, (bias + other_bias)[:, None]


def _run(inputs: Tensor, weight: Tensor, shared: Tensor | None, *, last: bool) -> Tensor:
    run: Callable[..., Tensor] = _Recurrence.apply
    return run(inputs, weight, shared, last)


class _Recurrence(Function):
    """Ticks of an LSTM: (T, I, N), (4H, I + H), (4H, N) or None -> (T, H, N), or the last alone.

    Gates stand in PyTorch's order: in, forget, candidate, out. With a = weight [input; state] + shared:

        i, f, g, o = sigmoid, sigmoid, tanh, sigmoid of a;  c' = f c + i g;  h' = o tanh(c')

    What is kept between the ticks is 2 c, so that tanh(c) needs no factor.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, shared: Tensor | None, last: bool) -> Tensor:  # noqa: ANN401  (torch's own context and order)
        ticks, width, samples = inputs.shape
        hidden = weight.shape[0] // 4
        doubled = weight.new_ones(4 * hidden, 1)
        doubled[2 * hidden : 3 * hidden] = 2
        scaled = weight * doubled
        constant = None if shared is None else shared * doubled
        minus_one = weight.new_tensor(-1.0)

        given = inputs.new_empty(ticks + 1, width + hidden, samples)  # input and state
        given[:ticks, :width] = inputs
        gates = inputs.new_empty(ticks, 4 * hidden, samples)
        cells = inputs.new_empty(ticks + 1, hidden, samples)  # 2 c
        cells[0] = 0
        squashed = inputs.new_empty(ticks, hidden, samples)  # tanh(c)
        for tick in range(ticks):
            gate, cell, squash = gates[tick], cells[tick + 1], squashed[tick]
            rows = width + hidden if tick else width  # the first state is zero
            if constant is None:
                torch.mm(scaled[:, :rows], given[tick, :rows], out=gate)
            else:
                torch.addmm(constant, scaled[:, :rows], given[tick, :rows], out=gate)
            gate.sigmoid_()
            into, forget, candidate, out = gate.chunk(4)
            torch.add(minus_one, candidate, alpha=2, out=candidate)
            torch.mul(forget, cells[tick], out=cell)
            cell.addcmul_(into, candidate, value=2)
            torch.sigmoid(cell, out=squash)
            torch.add(minus_one, squash, alpha=2, out=squash)
            torch.mul(out, squash, out=given[tick + 1, width:])
        ctx.save_for_backward(given, gates, cells, squashed, weight)
        ctx.width, ctx.shares, ctx.last = width, shared is not None, last
        return given[ticks, width:].clone() if last else given[1:, width:]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor | None, None]:  # noqa: ANN401  (as above)
        given, gates, cells, squashed, weight = ctx.saved_tensors
        (arriving,) = gradients
        ticks, hidden, samples = squashed.shape
        width: int = ctx.width
        halved = weight.new_ones(4 * hidden, 1)  # the forget gate's gradient is taken with 2 c in place of c
        halved[hidden : 2 * hidden] = 0.5
        transposed = (weight * halved).t().contiguous()

        of_inputs = weight.new_empty(ticks, width, samples)
        of_weight = torch.zeros_like(weight)
        of_shared = weight.new_zeros(4 * hidden, samples) if ctx.shares else None
        of_given = weight.new_zeros(width + hidden, samples)
        of_state = of_given[width:]
        of_cell, through = weight.new_zeros(hidden, samples), weight.new_empty(hidden, samples)
        of_gates = weight.new_empty(4 * hidden, samples)
        of_into, of_forget, of_candidate, of_out = of_gates.chunk(4)
        for tick in reversed(range(ticks)):
            if not ctx.last:
                of_state += arriving[tick]
            elif tick == ticks - 1:
                of_state.copy_(arriving)
            into, forget, candidate, out = gates[tick].chunk(4)
            torch.mul(of_state, squashed[tick], out=of_out)
            torch.mul(of_state, out, out=through)
            _aten.tanh_backward.grad_input(through, squashed[tick], grad_input=through)
            of_cell += through
            torch.mul(of_cell, candidate, out=of_into)
            torch.mul(of_cell, cells[tick], out=of_forget)
            torch.mul(of_cell, into, out=of_candidate)
            of_cell *= forget
            before, entering = of_gates[: 2 * hidden], gates[tick, : 2 * hidden]
            _aten.sigmoid_backward.grad_input(before, entering, grad_input=before)
            _aten.tanh_backward.grad_input(of_candidate, candidate, grad_input=of_candidate)
            _aten.sigmoid_backward.grad_input(of_out, out, grad_input=of_out)
            rows = width + hidden if tick else width
            of_weight[:, :rows].addmm_(of_gates, given[tick, :rows].t())
            if of_shared is not None:
                of_shared += of_gates
            torch.mm(transposed[:rows], of_gates, out=of_given[:rows])
            of_inputs[tick] = of_given[:width]
        of_weight *= halved
        if of_shared is not None:
            of_shared *= halved
        return of_inputs, of_weight, of_shared, None
