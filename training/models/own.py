"""Models of the user's own, named by module and class: `mymodule:MyModel`; see docs/own-models.md."""

import inspect
import sys
from importlib import import_module, reload
from pathlib import Path
from typing import Any, get_args

from tracklake.schemas.errors import UsageError
from tracklake.schemas.hashing import hash_chunks
from tracklake.training.data.observed import Reads
from tracklake.training.models import Model, Phase, Recipe

OWN_FILES: dict[str, tuple[str, str]] = {}
"""File and digest of each module that was imported for a model: an error raised in the file is not ours."""


def find_own_model(name: str) -> Model:
    """Import a class by `module:Class` and describe it like an entry of the registry.

    Modules are found in the working folder, too, but behind installed ones: no file there stands in for a library. The
    class may have a `recipe` (else 8 epochs of `mse`) and `reads`; arguments with defaults are its parameters.

    Raises:
        UsageError: the module cannot be imported, or the class is missing or no such model.
    """
    from tracklake.training.models.network import Network, PlaceNetwork

    (module, _, builder), here = name.partition(":"), str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        found = import_module(module)
        file = str(found.__file__)
        code = file, hash_chunks([Path(file).read_bytes()], 12)
        if OWN_FILES.get(module, code) != code:
            found = reload(found)  # edited while this process runs, as from a notebook
    except (Exception, SystemExit) as error:  # whatever the user's own code raises
        raise UsageError(
            f"model `{name}`: the module `{module}` cannot be imported ({type(error).__name__}: {error}). It is looked "
            f"for in the working folder, {here}, and among installed modules"
        ) from error
    own = getattr(found, builder, "no such name")
    OWN_FILES[module] = code
    if not (isinstance(own, type) and issubclass(own, Network)):
        raise UsageError(f"model `{name}`: expected a class derived from PlaceNetwork or Network in {file}, got {own}")
    arguments = [each for each in inspect.signature(own).parameters.values() if not each.kind.name.startswith("VAR")]
    methods = ("forward",) if issubclass(own, PlaceNetwork) else ("loss", "predict_tensors")
    recipe: Any = getattr(own, "recipe", Recipe((Phase("mse", 8),)))
    reads: Any = getattr(own, "reads", "grid")
    lacking = [f"the method `{method}`" for method in methods if getattr(own, method) is getattr(Network, method)]
    lacking += [] if arguments else ["an argument for the protocol"]
    lacking += [f"a default of the argument `{each.name}`" for each in arguments[1:] if each.default is each.empty]
    if not isinstance(recipe, Recipe) or reads not in get_args(Reads):
        lacking.append("a Recipe as `recipe`, or `grid` or `scene` as `reads`")
    if lacking:
        raise UsageError(f"model `{name}`: the class in {file} lacks {', '.join(lacking)}; see docs/own-models.md")
    parameters = {each.name: each.default for each in arguments[1:] if isinstance(each.default, int | float | str)}
    return Model(name, "a model of the user's own", "", module, builder, parameters, reads, recipe)
