"""sejax.cli.words: words from a preset file, and the file that stands for words."""

import pytest

import sejax
from sejax.cli import config as configuration
from sejax.options import ConfigError


def test_a_files_words_stand_in_its_place_and_those_beside_it_go_over_them(tmp_path):
    file = tmp_path / "mine, of today.yaml"
    file.write_text(
        "env: acrobot\nes:\n  noise_std: 0.3\n  score_transform: rank\n"
        "agent.learning_rate: 1e-3\nproxy.sizes: [1, a b]\nrun_dir:\n"
    )
    assert words.without_files(["seed=1", f"preset='{file}'", "es.noise_std=0.4"]) == [
        "seed=1", "env=acrobot", "es.score_transform=rank", "agent.learning_rate=1e-3",
        "proxy.sizes=[1,'a b']", "run_dir=null", "es.noise_std=0.4",
    ]  # fmt: skip


def test_a_written_file_stands_for_its_words(tmp_path):
    written = ["preset=paper", "agent.learning_rate=0.001", "agent=ddqn+ppo", "proxy='a b.yaml'",
               "proxy.sizes=[1,'a b']", "stop_when_solved=true", "run_dir=null"]  # fmt: skip
    (tmp_path / "x.yaml").write_text(words.file_text(written))
    assert words.without_files([f"preset={tmp_path / 'x.yaml'}"]) == written


def test_values_of_a_file_are_in_the_configuration_and_its_place_is_not(tmp_path):
    file = tmp_path / "x.yaml"
    file.write_text("preset: paper\nagent: ddqn\nagent.batch_size: 33\n")
    made = sejax.config([f"preset={file}", "agent.hidden_size=44"])
    assert made == sejax.config(["preset=paper", "agent.batch_size=33", "agent.hidden_size=44"])


def test_a_file_serves_sejax_evaluate(tmp_path):
    file = tmp_path / "x.yaml"
    file.write_text("proxy: cartpole\nagent: ppo\nagent.epochs: 3\n")
    made = configuration.evaluate_config([f"preset={file}"])
    assert (made.proxy, made.agent.epochs) == ("cartpole", 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"preset must be one of best, .*, or a YAML file; got \S+x\.yaml \(.*No such file"),
        ("a: [1", r"or a YAML file; got \S+x\.yaml \(.*expected"),
        ("", r"preset must be a file that maps fields to values.*x\.yaml with None"),
        ("- es.noise_std=1", "must be a file that maps fields to values"),
        ("hydra.run.dir: x", r"must be a file of choices and fields.*got hydra\.run\.dir in"),
        ("es:\n  1: 2\n a b: 3\n", "or a YAML file"),
        ("a=b: 3", "must be a file of choices and fields.*got a=b in"),
        ("preset: y.yaml", r"must be the name of one within a file.*got y\.yaml in"),
    ],
)
def test_a_file_that_is_none_gets_one_sentence(tmp_path, text, message):
    if text is not None:
        (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        words.without_files([f"preset={tmp_path / 'x.yaml'}"])


def test_files_are_not_swept():
    with pytest.raises(ConfigError, match=r"preset must be one, if it is a file.*got a\.yaml,best"):
        words.without_files(["preset=a.yaml,best"])
