"""docs/models.md, derived from the registry of models: `python -m tracklake.training.models.markdown`."""

import json
import sys

from tracklake.schemas.references import link_references
from tracklake.training.models import MODELS, Model

_HEAD = """\
# Models

Derived from `training/models/__init__.py`; do not edit (`make docs` writes it).

`tracklake train MODEL` trains one by its own recipe; `--set name=value` changes a parameter or what is learned by
(batch_size, learning_rate, optimizer, schedule, max_gradient_norm, augmentation). Fitted models need no torch:
`tracklake train` fits their parameters on the training part in one pass and writes a run, `tracklake evaluate MODEL`
fits them on the fly. Those without a recipe that are not fitted predict as they are. None is given the future or a true
maneuver: `predict` gets `training.data.observed.Observed` (the sample and the neighbors in its grid) or `ObservedScene`
(the sample and the vehicles nearest to it), and nothing else.

`anchoring` names the axes on which a network's outputs are counted from constant velocity: `both`, `longitudinal`,
`lateral` or `none`. On other axes they are counted from the last position, as published. `residual` is its former name:
true stands for `both`, false for `none`.
"""

_PUBLISHED = """\
## As published

`--set as_published=true` trains a network with the inputs, outputs and loss of its publication; settings that are given
beside it count. The run's `config.json` holds what it sets. `--patience N` trains until the validation loss stops
improving.

| model | ours | as published | what differs even then |
| --- | --- | --- | --- |"""


def write_models() -> str:
    """Return the page as Markdown."""
    compared = [_compare(model) for model in MODELS.values() if model.published]
    return "\n".join([_HEAD, *(_describe(model) for model in MODELS.values()), _PUBLISHED, *compared, ""])


def _compare(model: Model) -> str:
    """Return the row of a network's own settings and of those of its publication."""
    ours, theirs = (
        ", ".join(f"`{name}={json.dumps(values[name]).strip(chr(34))}`" for name in model.published)
        for values in (model.parameters, model.published)
    )
    return f"| `{model.name}` | {ours} | {theirs} | {model.differs} |"


def _describe(model: Model) -> str:
    """Return the section of one model."""
    lines = [f"## {model.name}", "", f"{model.meaning[0].upper()}{model.meaning[1:]}.", ""]
    lines += [f"- source: {link_references(model.source) or 'ours'}", f"- reads: the {model.reads}"]
    if model.parameters:
        lines.append(f"- parameters: {', '.join(f'`{name}` = {value}' for name, value in model.parameters.items())}")
    if model.fitted:
        lines.append("- fitted: parameters that are not set; the defaults above hold where `train` has no samples")
    if (recipe := model.recipe) is not None:
        phases = ", then ".join(f"{phase.epochs} epochs of `{phase.loss}`" for phase in recipe.phases)
        lines.append(
            f"- recipe: {phases}; batches of {recipe.batch_size}, {recipe.optimizer} at {recipe.learning_rate:g} "
            f"({recipe.schedule}), gradients clipped at {recipe.max_gradient_norm:g}"
        )
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.stdout.write(write_models().rstrip("\n") + "\n")
