"""The git revision of the checkout that the program runs from."""

from pathlib import Path


def git_revision(root: Path | None = None) -> str | None:
    """The commit of a checkout, read from git's files; None outside a checkout, or before its first commit."""
    root = Path(__file__).resolve().parents[2] if root is None else root
    try:
        folder = _git_folder(root / ".git")
        common = folder / _first_line(folder / "commondir") if (folder / "commondir").exists() else folder
        head = _first_line(folder / "HEAD")
        for _ in range(5):  # a symbolic reference may name another; git follows five
            if not head.startswith("ref: "):
                return head
            head = _resolved(head.removeprefix("ref: "), folder, common)
    except (OSError, KeyError, UnicodeDecodeError):
        pass
    return None


def _git_folder(path: Path) -> Path:
    """`.git` itself, or the folder named by the file in its place (a worktree or a submodule)."""
    return path if path.is_dir() else path.parent / _first_line(path).removeprefix("gitdir: ")


def _resolved(reference: str, folder: Path, common: Path) -> str:
    """The commit of a reference: loose, this worktree's first, or packed."""
    for place in (folder, common):
        if (place / reference).is_file():
            return _first_line(place / reference)
    packed = [line.split(" ", 1) for line in (common / "packed-refs").read_text().splitlines() if line[:1] not in "#^"]
    return {name: revision for revision, name in packed}[reference]


def _first_line(path: Path) -> str:
    return path.read_text().partition("\n")[0].strip()
