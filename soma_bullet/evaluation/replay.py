"""An episode of an evaluation once more, exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from soma_bullet.assembly.file import load_assembly
from soma_bullet.episode import run_episode
from soma_bullet.errors import InputError
from soma_bullet.evaluation.folder import LINES, make_folder, read_lines
from soma_bullet.evaluation.line import Line, options_of, outcome
from soma_bullet.evaluation.options import EvaluationOptions
from soma_bullet.evaluation.workers import in_processes
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.options import FilmOptions


@dataclass(frozen=True)
class Replay:
    """An episode that was run again: the line of then, that of now, and where its files are."""

    before: Line
    after: Line
    folder: Path

    @property
    def same(self) -> bool:
        """Whether every pose of every piece was the same; where nothing was executed, whether it ended
        alike."""
        keys = ("log_sha256", "success", "cause")
        return all(self.before.get(key) == self.after.get(key) for key in keys)


def replay(assembly: str, seed: int, out: Path, film: FilmOptions | None) -> Replay:
    """Run the episode of one line of `out`/episodes.jsonl again, under that line's conditions, into
    `out`/replay_SEED.

    Raises:
        InputError: there is no such line, or it was made of another assembly.
    """
    line = next((line for line in read_lines(out / LINES) if line["seed"] == seed), None)
    if line is None:
        raise InputError("--replay", f"{out / LINES} has no line of seed {seed}")
    digest = load_assembly(assembly).digest
    if line.get("digest") != digest:
        raise InputError(
            "--replay", f"that line was made of another assembly: {line.get('assembly')}, not {assembly}"
        )
    episode, folder = options_of(line, str(out / LINES)), out / f"replay_{seed}"
    make_folder(folder)
    for name in ("log.npz", "program.npz", "plan.json", "report.json", "episode.mp4", "still.png"):
        (folder / name).unlink(missing_ok=True)  # of an earlier replay
    (after,) = in_processes([seed], EvaluationOptions(assembly), 1, _Again(episode, folder))
    if film is not None and "log_sha256" in after:
        run_episode(assembly, replace(episode, film=film), folder, folder / "log.npz")
    return Replay(line, after, folder)


@dataclass(frozen=True)
class _Again:
    """Runs one episode as it was, and leaves its files in a folder."""

    episode: EpisodeOptions
    folder: Path

    def __call__(self, seed: int, options: EvaluationOptions) -> Line:
        return {"seed": seed, "success": False} | outcome(options.assembly, self.episode, self.folder)
