"""Multi-head attention over vehicles or lanes of which some may be absent."""

import math

import torch
from torch import Tensor, nn

from tracklake.schemas.errors import UsageError


def masked_softmax(scores: Tensor, present: Tensor) -> Tensor:
    """Weights that sum to 1 over the keys that are there and are 0 elsewhere; all 0 where no key is there.

    Args:
        scores: (B, heads, Q, K) finite.
        present: (B, K) True where there is a key.
    """
    absent = ~present[:, None, None, :]
    # The least number, not minus infinity: a row without any key would turn into NaN, and so would its gradient.
    weights = torch.softmax(scores.masked_fill(absent, torch.finfo(scores.dtype).min), dim=-1)
    return weights.masked_fill(absent, 0.0)


class MultiHeadAttention(nn.Module):
    """Queries attend to keys in several heads; what they find is added to them and normalised.

    Per head, queries, keys and values are projected to `head_width` numbers; weights are the softmax of the products
    of queries and keys, divided by sqrt(head_width). The heads' sums of values are mapped back to the queries' width,
    pass dropout and are added to the queries; layer normalisation follows (Vaswani et al. 2017; Kim et al. 2020).
    """

    def __init__(
        self, query_width: int, key_width: int, *, heads: int, head_width: int, dropout: float, epsilon: float
    ) -> None:
        """Prepare for embeddings of given widths.

        Args:
            query_width: of the queries, and of what comes out.
            key_width: of what keys and values are made from.
            heads: how many.
            head_width: of queries, keys and values in a head.
            dropout: probability with which a number of the attention's output is dropped before it is added.
            epsilon: of the layer normalisation.

        Raises:
            ValueError: no heads.
        """
        super().__init__()
        if heads < 1:
            raise UsageError(f"attention with {heads} heads: expected at least 1")
        self.heads, self.head_width = heads, head_width
        self.query = nn.Linear(query_width, heads * head_width)
        self.key = nn.Linear(key_width, heads * head_width)
        self.value = nn.Linear(key_width, heads * head_width)
        self.back = nn.Linear(heads * head_width, query_width)
        self.dropout = nn.Dropout(dropout)
        self.norm = nn.LayerNorm(query_width, eps=epsilon)

    def forward(self, queries: Tensor, keys: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """Attend.

        Args:
            queries: (B, Q, query_width) finite.
            keys: (B, K, key_width) finite, also where absent.
            present: (B, K) True where there is a key; where there is none at all, nothing is added to the queries.

        Returns:
            (B, Q, query_width), and the weights (B, heads, Q, K).
        """
        query, key, value = (self._part(of) for of in (self.query(queries), self.key(keys), self.value(keys)))
        weights = masked_softmax(query @ key.transpose(-1, -2) / math.sqrt(self.head_width), present)
        joined = (weights @ value).transpose(1, 2).flatten(start_dim=2)  # (B, Q, heads * head_width)
        found = self.back(joined).masked_fill(~present.any(dim=-1)[:, None, None], 0.0)
        return self.norm(queries + self.dropout(found)), weights

    def _part(self, projected: Tensor) -> Tensor:
        """(B, N, heads * head_width) -> (B, heads, N, head_width)."""
        return torch.unflatten(projected, -1, (self.heads, self.head_width)).transpose(1, 2)


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """One hidden layer with ReLU, and a linear layer; where `hidden` is 0, the linear layer alone."""
    if not hidden:
        return nn.Sequential(nn.Linear(inputs, outputs))
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))
