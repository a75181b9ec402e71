"""The study: its storage, and the loop in which a worker takes one trial after another.

Workers of a study share nothing but the database. Each shows by heartbeats that it lives; a trial
whose worker has not done so for some time counts as failed, and is queued again.
"""

import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import optuna
from optuna.trial import TrialState

from sejax.errors import ConfigError, require, shortened
from sejax.search.settings import Search, completed
from sejax.search.storage import GRACE, open_storage, quietly, unusable
from sejax.search.trials import Follower, Lost, Progress, take_over

STORED = "sejax"  # the study's attribute that holds what is searched
RETRIES = 3  # of a trial; one that takes its process down each time is given up then
MAKING_S = 5  # for another process to write what a study searches
REDUCTION_FACTOR = 3  # eta of Hyperband
HISTORY = "retried"  # the trial's attribute with the numbers of those before


class Runner(Protocol):
    """What makes a trial of settings: `sejax.search.learning` and `tuning`."""

    command: str

    def config(self, words: list[str], folder: Path | None = None) -> Any: ...
    def run(self, config: Any, follower: Follower, is_inherited: bool) -> Progress: ...
    def num_fresh(self) -> int: ...
    def verify(self, words: list[str], number: int) -> dict[str, float]: ...
    def order(self, row: dict[str, float]) -> tuple[float, float]: ...


def runner_of(search: Search) -> Runner:
    """What makes the trials of a search."""
    if search.is_of_agent:
        from sejax.search.tuning import Tuning

        return Tuning(search)
    from sejax.search.learning import Learning

    return Learning(search)


def open_study(
    search: Search, usual: Mapping[str, Any] | None = None
) -> tuple[optuna.Study, Search]:
    """Makes the study, or joins one that is there.

    Args:
      search: what is searched.
      usual: values of fields, by name, that a new study tries first: what one has is what one wants
        to beat. Not tried if they are not among what is searched.

    Returns:
      The study, and what it searches: with `study=NAME` and no word of what to search, that is what
      the study's maker asked for.

    Raises:
      ConfigError: if the storage cannot be used, the study is one of other settings, or there is
        nothing to search.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    logging.getLogger("alembic").setLevel(logging.WARNING)
    if not search.names_study_alone:
        require(
            search.space,
            "space",
            "be given, or sweeps of fields",
            "there is nothing to search otherwise",
            "none",
            "space=paper_se, or es.noise_std='tag(log, interval(0.01, 0.3))'",
        )
    storage = open_storage(search, queue_again)
    try:
        with quietly():
            if search.names_study_alone:
                _require_study(search, storage)
            study = optuna.create_study(
                study_name=search.study,
                storage=storage,
                direction="maximize",
                sampler=_sampler(search),
                pruner=_pruner(search),
                load_if_exists=True,
            )
        stored = study.user_attrs.get(STORED)
        if stored is not None:
            joined = _joined(search, completed(stored))
            if joined.config.heartbeat != search.config.heartbeat:
                return open_study(joined, usual)  # each worker goes by the same
            search = joined
            study.sampler, study.pruner = _sampler(search, study), _pruner(search)
        else:
            study.set_user_attr(STORED, search.stored())
            first = (
                {x.parameter: x.parameter_of(usual.get(name)) for name, x in search.space.items()}
                if usual
                else {}
            )
            if first and None not in first.values():
                with quietly():
                    study.enqueue_trial(first, skip_if_exists=True)
    except optuna.exceptions.StorageInternalError as error:
        raise unusable(search, error) from error
    return study, search


def _require_study(search: Search, storage: optuna.storages.RDBStorage) -> None:
    """Checks that a study which is named alone is there, and waits while another process makes it.

    Raises:
      ConfigError: if it is not.
    """
    for _ in range(MAKING_S):
        made = {each.study_name: each for each in optuna.get_all_study_summaries(storage)}
        if search.study in made and STORED in made[search.study].user_attrs:
            return
        if search.study not in made:
            break
        time.sleep(1.0)
    there = [name for name, each in made.items() if STORED in each.user_attrs]
    raise ConfigError(
        f"study must be one that is there, because nothing says what to search otherwise; got "
        f"{shortened(search.study)}, and the storage has {', '.join(there) or 'none'}. Set "
        f"study=NAME storage=URL, or say what to search: space=paper_se."
    )


def work(
    study: optuna.Study, search: Search, runner: Runner, say: Callable[[str], None] = print
) -> None:
    """Takes trials until as many as asked for have ended, and all that others left behind.

    With several workers a few more than `trials` may end, as each looks before it takes one.

    Raises:
      KeyboardInterrupt: after queueing the trial at hand again, as after the following.
      ConfigError, OSError: of a trial that cannot be written.
    """
    config, started, waits = search.config, time.monotonic(), False
    objective = Objective(search, runner, say)
    while config.timeout is None or time.monotonic() - started < config.timeout:
        fail_stale(study)
        count = Counter(trial.state for trial in study.get_trials(deepcopy=False))
        ended = count[TrialState.COMPLETE] + count[TrialState.PRUNED]
        if ended >= config.trials and not count[TrialState.WAITING] + count[TrialState.RUNNING]:
            return
        if count[TrialState.WAITING] or ended + count[TrialState.RUNNING] < config.trials:
            waits = False
            _run_one(study, objective)
        else:
            if not waits:
                say(
                    f"Waiting for {count[TrialState.RUNNING]} trials of other workers, or for "
                    f"their heartbeats to end ({GRACE * config.heartbeat} s)."
                )
                begin_heartbeats(study)
            waits = True
            time.sleep(min(1.0, config.heartbeat))


def fail_stale(study: optuna.Study) -> None:
    """Counts trials as failed whose heartbeats have ended, and queues them again."""
    with quietly():
        optuna.storages.fail_stale_trials(study)


def begin_heartbeats(study: optuna.Study) -> None:
    """Records a heartbeat of each running trial, as a worker that died before its first had none.

    Optuna would take such a trial for one that goes on for ever. A worker that lives records later
    ones.
    """
    if optuna.storages._heartbeat.is_heartbeat_enabled(study._storage):
        for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            study._storage.record_heartbeat(trial._trial_id)


class Objective:
    """What Optuna calls for a trial.

    Attributes:
      trial: the last one.
      is_done: whether all of it is computed, or it was found to be another worker's.
      is_interrupted: whether a person has ended it.
    """

    def __init__(self, search: Search, runner: Runner, say: Callable[[str], None]):
        self._search, self._runner, self.say = search, runner, say
        self.trial: Any = None
        self.is_done = self.is_interrupted = False

    def __call__(self, trial: optuna.Trial) -> float:
        self.trial = trial
        try:
            words = [f"{name}={x.suggest(trial)}" for name, x in self._search.space.items()]
            score = self._run(trial, words)
        except optuna.TrialPruned:
            self.say(sentence(trial, "pruned", self._search))
            self.is_done = True
            raise
        except (Lost, optuna.exceptions.UpdateFinishedTrialError):
            self.is_done = True
            raise
        except KeyboardInterrupt:
            self.is_interrupted = True  # Optuna raises another error if it cannot end the trial
            raise
        self.say(sentence(trial, "complete", self._search))
        self.is_done = True
        return score

    def _run(self, trial: optuna.Trial, words: list[str]) -> float:
        folder = trial_folder(self._search, trial.number)
        history = trial.user_attrs.get(HISTORY, [])
        before = [trial_folder(self._search, number) for number in history]
        is_inherited = take_over(folder, before)
        try:
            config = self._runner.config(words, folder)
        except ConfigError as error:  # settings that cannot work together are no trial's fault
            trial.set_user_attr("refused", str(error))
            raise optuna.TrialPruned from error
        follower = Follower(trial, self._search)
        return follower.finish(self._runner.run(config, follower, is_inherited))


def sentence(trial: optuna.Trial | optuna.trial.FrozenTrial, how: str, search: Search) -> str:
    """What is said of a trial that has ended: complete or pruned."""
    kept = trial.user_attrs
    if "refused" in kept:
        return f"trial {trial.number}: refused: {kept['refused']}"
    score = kept.get(search.config.score)
    worth = "not finite" if score is None else f"{score:.4g}"
    words = " ".join(f"{name}={x.of(trial.params)}" for name, x in search.space.items())
    return (
        f"trial {trial.number}: {worth}, {how} at generation "
        f"{kept['generations']}/{search.config.max_generations}: {words}"
    )


def trial_folder(search: Search, number: int) -> Path:
    return search.folder / "trials" / f"{number:04d}"


def queue_again(study: optuna.Study, trial: optuna.Trial | optuna.trial.FrozenTrial) -> None:
    """Queues a trial that its worker did not end, under a new number and with the same settings.

    What Hyperband noted of it stays behind: the new number is of another bracket, and the trial's
    generations so far are told there anew, from its files.
    """
    history = [*trial.user_attrs.get(HISTORY, []), trial.number]
    others = study.get_trials(deepcopy=False)
    if len(history) > RETRIES or any(x.user_attrs.get(HISTORY) == history for x in others):
        return  # given up, or another worker has queued it
    study.add_trial(
        optuna.create_trial(
            state=TrialState.WAITING,
            params=trial.params,
            distributions=trial.distributions,
            user_attrs={HISTORY: history},
        )
    )


def _run_one(study: optuna.Study, objective: Objective) -> None:
    objective.trial, objective.is_done = None, False
    with quietly():
        try:
            study.optimize(objective, n_trials=1)
        except KeyboardInterrupt:
            if _has_failed(study, objective.trial):
                queue_again(study, objective.trial)
            raise
        except Exception as error:  # of several kinds, where Optuna cannot end what another has
            has_failed = _has_failed(study, objective.trial)
            if has_failed and not objective.is_done:
                queue_again(study, objective.trial)  # a full disk, or no memory here
            if objective.is_interrupted:
                raise KeyboardInterrupt from error
            if not (has_failed and objective.is_done):
                raise
            objective.say(
                f"trial {objective.trial.number}: was taken for dead and is another worker's now"
            )


def _has_failed(study: optuna.Study, trial: optuna.Trial | None) -> bool:
    """Whether a trial, if there is one, counts as failed by now."""
    failed = study.get_trials(deepcopy=False, states=(TrialState.FAIL,))
    return trial is not None and trial.number in [each.number for each in failed]


def _sampler(search: Search, joined: optuna.Study | None = None) -> optuna.samplers.BaseSampler:
    """The sampler, which draws anew in a study that is joined or goes on."""
    seed = search.config.sampler_seed
    if seed is not None and joined is not None:
        trials = joined.get_trials(deepcopy=False)
        is_alone = trials and not any(trial.state == TrialState.RUNNING for trial in trials)
        others = [] if is_alone else [os.getpid()]  # workers that come at the same time
        seed = int(np.random.SeedSequence([seed, len(trials), *others]).generate_state(1)[0])
    if search.config.sampler == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed)


def _pruner(search: Search) -> optuna.pruners.BasePruner:
    config = search.config
    match config.pruner:
        case "hyperband":
            return optuna.pruners.HyperbandPruner(
                config.min_generations, config.max_generations, REDUCTION_FACTOR
            )
        case "median":
            return optuna.pruners.MedianPruner(n_warmup_steps=config.min_generations)
    return optuna.pruners.NopPruner()


def _joined(search: Search, stored: dict[str, Any]) -> Search:
    """The stored search with a worker's own free fields.

    Raises:
      ConfigError: if the worker asks for another search.
    """
    if not search.names_study_alone:
        asked = search.stored()
        differing = [
            f"{name} ({there.get(name, 'not')} there, {here.get(name, 'not')} here)"
            for part in ("search", "space")
            for there, here in [(stored[part], asked[part])]
            for name in sorted(there.keys() | here.keys())
            if there.get(name) != here.get(name)
        ]
        if sorted(stored["fixed"]) != sorted(asked["fixed"]):
            differing.append(f"{' '.join(stored['fixed'])} there, {' '.join(asked['fixed'])} here")
        require(
            not differing,
            "study",
            "be new or of the same search",
            "its trials are compared with each other",
            f"{search.study}, which differs in {', '.join(differing)}",
            "study=NAME, or give study and storage alone to join",
        )
    return Search.from_stored(stored, search.config, search.machines)
