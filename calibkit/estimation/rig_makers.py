"""Which recordings the entries of two rig files were made from, and which entries share one."""

from collections.abc import Iterable, Mapping

from calibkit.data.rig import InputFile, Rig
from calibkit.errors import one_line

_NO_RECORDINGS = (".yaml", ".yml")  # boards and rigs


def shared_recordings(old: Rig, new: Rig, entries: Iterable[str]) -> Mapping[str, tuple[str, ...]]:
    """Return the entries (`cameras.cam0`; transforms and offsets in either direction) that both made from one recording, by its name."""
    found: dict[str, list[str]] = {}
    for entry in entries:
        before, after = _recordings(old, entry), _recordings(new, entry)
        for digest in before.keys() & after.keys():
            found.setdefault(before[digest], []).append(entry)
    return {name: tuple(made) for name, made in sorted(found.items())}


def _recordings(rig: Rig, entry: str) -> dict[str, str]:
    """Return name by SHA-256 of what the entry was made from: of its latest stage, of all stages where the file does not say which."""
    makers = [run for run in rig.provenance if {entry, _reversed(entry)} & set(run.made)]
    unsaid = [run for run in rig.provenance if not run.made] if not makers else []
    files: list[InputFile] = [file for run in (*makers[-1:], *unsaid) for file in run.inputs]
    return {file.sha256: one_line(file.name, 80) for file in files if file.sha256 is not None and not file.name.endswith(_NO_RECORDINGS)}


def _reversed(entry: str) -> str:
    """Return `transforms.T_b_a` of `transforms.T_a_b`."""
    section, _, name = entry.partition(".")
    kind, *frames = name.split("_")
    return f"{section}.{'_'.join([kind, *reversed(frames)])}"
