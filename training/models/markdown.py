"""docs/models.md, derived from the registry of models: `python -m tracklake.training.models.markdown`."""

import sys

from tracklake.schemas.references import link_references
from tracklake.training.models import MODELS, Model

_HEAD = """\
# Models

Derived from `training/models/__init__.py`; do not edit (`make docs` writes it).

`tracklake train MODEL` trains one by its own recipe; `--set name=value` changes a parameter or what is learned by
(batch_size, learning_rate, optimizer, schedule, max_gradient_norm). Those without a recipe predict as they are. None is
given the future or a true maneuver: `predict` gets `training.data.observed.Observed` (the sample and the
neighbors in its grid) or `ObservedScene` (the sample and the vehicles nearest to it), and nothing else.
"""


def write_models() -> str:
    """Return the page as Markdown."""
    return "\n".join([_HEAD, *(_describe(model) for model in MODELS.values())])


def _describe(model: Model) -> str:
    """Return the section of one model."""
    lines = [f"## {model.name}", "", f"{model.meaning[0].upper()}{model.meaning[1:]}.", ""]
    lines += [f"- source: {link_references(model.source) or 'ours'}", f"- reads: the {model.reads}"]
    if model.parameters:
        lines.append(f"- parameters: {', '.join(f'`{name}` = {value}' for name, value in model.parameters.items())}")
    if (recipe := model.recipe) is not None:
        phases = ", then ".join(f"{phase.epochs} epochs of `{phase.loss}`" for phase in recipe.phases)
        lines.append(
            f"- recipe: {phases}; batches of {recipe.batch_size}, {recipe.optimizer} at {recipe.learning_rate:g} "
            f"({recipe.schedule}), gradients clipped at {recipe.max_gradient_norm:g}"
        )
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.stdout.write(write_models().rstrip("\n") + "\n")
