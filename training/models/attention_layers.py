"""Multi-head attention over vehicles or lanes, some of which may be absent."""

import math

import torch
from torch import Tensor, nn

from tracklake.schemas.errors import UsageError


def masked_softmax(scores: Tensor, present: Tensor) -> Tensor:
    """Return weights that sum to 1 over the present keys and are 0 elsewhere; all 0 where no key is present.

    Args:
        scores: (B, heads, Q, K) finite.
        present: (B, K) True where there is a key.
    """
    absent = ~present[:, None, None, :]
    # The least number, not minus infinity: a row without any key would turn into NaN, and so would its gradient.
    weights = torch.softmax(scores.masked_fill(absent, torch.finfo(scores.dtype).min), dim=-1)
    return weights.masked_fill(absent, 0.0)


class MultiHeadAttention(nn.Module):
    """Queries attend to keys in several heads; the result is added to them and normalised.

    Per head, queries, keys and values are projected to `head_width` numbers; weights are the softmax of the products
    of queries and keys, divided by sqrt(head_width). The heads' sums of values are mapped back to the queries' width,
    pass dropout and are added to the queries; layer normalisation follows (Vaswani et al. 2017; Kim et al. 2020).
    """

    def __init__(
        self, query_width: int, key_width: int, *, heads: int, head_width: int, dropout: float, epsilon: float
    ) -> None:
        """Build the layers for embeddings of given widths.

        Args:
            query_width: width of the queries and of the result.
            key_width: width of the vectors that keys and values are computed from.
            heads: number of heads.
            head_width: width of queries, keys and values in a head.
            dropout: probability with which a number of the attention's output is dropped before it is added.
            epsilon: epsilon of the layer normalisation.

        Raises:
            UsageError: there are no heads.
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
        """Let queries attend to keys.

        Args:
            queries: (B, Q, query_width) finite.
            keys: (B, K, key_width) finite, also where absent.
            present: (B, K) True where there is a key; where there is none at all, nothing is added to the queries.

        Returns:
            The queries (B, Q, query_width) with the result added, and the weights (B, heads, Q, K).
        """
        query, key, value = (self._split(of) for of in (self.query(queries), self.key(keys), self.value(keys)))
        weights = masked_softmax(query @ key.transpose(-1, -2) / math.sqrt(self.head_width), present)
        joined = (weights @ value).transpose(1, 2).flatten(start_dim=2)  # (B, Q, heads * head_width)
        found = self.back(joined).masked_fill(~present.any(dim=-1)[:, None, None], 0.0)
        return self.norm(queries + self.dropout(found)), weights

    def _split(self, projected: Tensor) -> Tensor:
        """Reshape (B, N, heads * head_width) to (B, heads, N, head_width)."""
        return torch.unflatten(projected, -1, (self.heads, self.head_width)).transpose(1, 2)


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Return one hidden layer with ReLU and a linear layer; where `hidden` is 0, the linear layer alone."""
    if not hidden:
        return nn.Sequential(nn.Linear(inputs, outputs))
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))
