"""Reading source files without importing them: what the tests of layout and of style have in common."""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Source:
    """A Python file below a folder."""

    root: Path
    """Folder that the names of files are given from; its own name is that of the package."""
    path: Path

    @property
    def name(self) -> str:
        """Name of the file from the folder, as it is printed."""
        return str(self.path.relative_to(self.root))

    @property
    def module(self) -> str:
        """Full name of the module; that of the package for an `__init__`."""
        parts = self.path.relative_to(self.root.parent).with_suffix("").parts
        return ".".join(parts).removesuffix(".__init__")

    @property
    def room(self) -> str:
        """First folder below the root, '' for files that lie in the root itself."""
        parts = self.path.relative_to(self.root).parts
        return parts[0] if len(parts) > 1 else ""

    @property
    def is_package(self) -> bool:
        """Whether the file is the `__init__` of a package."""
        return self.path.name == "__init__.py"

    @property
    def is_command(self) -> bool:
        """Whether the file is run by `python -m`."""
        return 'if __name__ == "__main__"' in self.text

    @cached_property
    def text(self) -> str:
        return self.path.read_text(encoding="utf-8")

    @cached_property
    def lines(self) -> list[str]:
        return self.text.splitlines()

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.text, str(self.path))

    def functions(self) -> Iterator[Function]:
        """All functions, methods and inner functions."""
        return (node for node in ast.walk(self.tree) if isinstance(node, Function))

    def public_functions(self) -> Iterator[tuple[str, Function]]:
        """Functions at the top of the module and methods of its classes, by dotted names without a leading underscore."""
        for node in self.tree.body:
            if isinstance(node, Function):
                yield node.name, node
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield from ((f"{node.name}.{inner.name}", inner) for inner in node.body if isinstance(inner, Function))

    def imports(self, module_level_only: bool = False) -> set[str]:
        """Full names of modules and of the names taken from them; imports inside functions count unless told otherwise."""
        nodes = self.tree.body if module_level_only else list(ast.walk(self.tree))
        names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        for node in nodes:
            if isinstance(node, ast.ImportFrom):
                if node.level:
                    raise AssertionError(f"{self.name}:{node.lineno} imports by a relative name; import by the full name")
                names |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
        return names


def read_sources(root: Path) -> list[Source]:
    """All Python files below a folder, in order of their names."""
    return [Source(root, path) for path in sorted(root.rglob("*.py")) if "__pycache__" not in path.parts]
