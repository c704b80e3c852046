"""Which functions of the core and of storage other packages call: found from the imports."""

import ast
from pathlib import Path

PREFIX = "spheremark"


def modules_below(root: Path) -> dict[str, ast.Module]:
    """Return the syntax trees of all modules by dotted name."""
    paths = [
        p for top in ("pipelines", "storage", "web", "service") for p in root.glob(f"{top}/**/*.py")
    ]
    names = [".".join((PREFIX, *p.relative_to(root).with_suffix("").parts)) for p in paths]
    names = [name.removesuffix(".__init__") for name in names]
    return {n: ast.parse(p.read_text()) for n, p in zip(names, paths, strict=True)}


def called_from_outside(trees: dict[str, ast.Module]) -> set[str]:
    """Return the public functions of ``pipelines`` and ``storage`` that another package imports."""
    origins = {
        (module, alias.asname or alias.name): (node.module, alias.name)
        for module, tree in trees.items()
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module in trees
        for alias in node.names
    }
    used = set()
    for module, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module in trees:
                for alias in node.names:
                    place = (node.module, alias.name)
                    while origins.get(place, place) != place:
                        place = origins[place]
                    if _package(place[0]) != _package(module):
                        used.add(place)
    functions = {
        (module, node.name)
        for module, tree in trees.items()
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
    }
    return {
        f"{module}.{name}"
        for module, name in used & functions
        if module.split(".")[1] in ("pipelines", "storage") and not name.startswith("_")
    }


def _package(module: str) -> str:
    """Return the package of a module, such as ``spheremark.pipelines.sphere``."""
    return ".".join(module.split(".")[:3])
