"""What the scripts are asked for is checked before a run directory is made."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf
from processes import run_script

from torchrl_ecpo.experiment import check_command_line, compose_options
from torchrl_ecpo.experiment.options import flatten, words_of

SCRIPTS = Path(__file__).parents[1] / "sota-implementations"
SCHEDULE = "loss.tau={schedule:linear,start:1,end:0,duration:4}"


def split(options):
    """The script, and its options."""
    first, *others = options.split()
    return ("ecac", others) if first == "ecac" else ("ecpo", [first, *others])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        # Names, with "+" or without; those of another script.
        ("loss.tua=1", "There is no option loss.tua; the nearest one is loss.tau."),
        ("++optim={learning_rate:1}", "no option optim.learning_rate"),
        ("+device=cuda", "There is no option device; the nearest one is"),
        ("settings=group_curriculum", "no option settings; the nearest one is setting."),
        ("env.bandit.num_actions=3", "no option env.bandit.*nearest one is env.num_actions."),
        ("env=copy env.hidden_size=8", "env.hidden_size; the nearest one is policy.hidden_size."),
        ("ecac optim.lr=7", "optim.lr must be a mapping, got 7."),
        # Former names.
        ("ecac loss.options.tau=1", "^loss.options.tau is called loss.tau.$"),
        ("ecac +loss.lr.log_tau=1", "^loss.lr.log_tau is called optim.lr.log_tau.$"),
        ("ecac ~loss.lr.log_tau", "^loss.lr.log_tau is called optim.lr.log_tau.$"),
        ("evaluation_interval=5", "^evaluation_interval is called evaluation.interval.$"),
        ("env=gym env.hidden_sizes=[8]", "^env.hidden_sizes is called hidden_sizes.$"),
        # All at once, in a line each.
        (
            "loss.tua=1 optim.lr=fast evaluation_interval=5 anneal_from={at_most:1}",
            "^evaluation_interval is called evaluation.interval.\n"
            "anneal_from.metric must be given.\n"
            "anneal_from.at_least must be given.\n"
            "There is no option anneal_from.at_most; the nearest one is .*\n"
            "optim.lr must be a number > 0, got 'fast'.\n"
            "There is no option loss.tua; the nearest one is loss.tau.$",
        ),
        (
            "ecac env=ants loss=ecpo gama=1",
            "^There is no env=ants; .*\nThere is no loss=ecpo; there",
        ),
        ("ecac env=gym loss.tua=1", "^env.name must be given.\nThere is no option loss.tua;"),
        # Numbers with an exponent are integers, if they are.
        ("num_groups=1.5e0", "num_groups must be an integer >= 1, got 1.5."),
        ("ecac loss=sac +loss.tau=1", "no option loss.tau"),
        ("ecac loss=sac loss.reference_interval=1", "no option loss.reference_interval"),
        ("~group_size", "group_size must be given."),
        ("ecac env=gym", "env.name must be given."),
        ("anneal_from={metric:entropy}", "anneal_from.at_least must be given."),
        # Kinds.
        ("loss.control_variate=no", "loss.control_variate must be true or false, got 'no'."),
        ("compile=1", "compile must be true or false, got 1."),
        ("optim=1", "optim must be a mapping, got 1."),
        ("num_groups=true", "num_groups must be an integer >= 1, got True."),
        ("num_groups=null", "num_groups must be an integer >= 1, got None."),
        ("optim.lr=fast", "optim.lr must be a number > 0, got 'fast'."),
        ("resume=3", "resume must be text or null, got 3."),
        ("env=gym hidden_sizes=64", "hidden_sizes must be a list, got 64."),
        ("env=gym hidden_sizes=[64,0]", r"hidden_sizes\[1\] must be an integer >= 1, got 0."),
        ("ecac loss.target_entropy=ayto", "must be a number or auto or null, got 'ayto'."),
        ("loss.tau.start=1", "loss.tau: .*schedule must be one of"),
        (SCHEDULE.replace("end", "to"), "loss.tau: Wrong arguments for the schedule 'linear'"),
        (SCHEDULE.replace("0", "-1"), "loss.tau.end must be a number >= 0, got -1."),
        # Ranges and choices.
        ("optim.max_grad_norm=0", "optim.max_grad_norm must be a number > 0 or null, got 0."),
        ("optim.lr=inf", "optim.lr must be a number > 0, got inf."),
        ("loss.tau=-1", "loss.tau must be a number >= 0 or a schedule, got -1."),
        ("group_size=1", "group_size must be an integer >= 2, got 1."),
        ("epochs=0", "epochs must be an integer >= 1, got 0."),
        ("max_kl=-1", "max_kl must be a number >= 0 or null, got -1."),
        ("env=copy policy.window=0", "policy.window must be an integer >= 1 or null, got 0."),
        ("loss.entropy=bits", "loss.entropy must be nats or matched, got 'bits'."),
        ("stop_when={metric:return,at_least:1}", "stop_when.batches must be given."),
        ("stop_when={metric:return,at_least:1,batches:0}", "stop_when.batches must be an integer"),
        ("seed=-1", "seed must be an integer >= 0 and < 1000000, got -1."),
        ("seed=1000000", "seed must be an integer >= 0 and < 1000000, got 1000000."),
        ("checkpoint.keep=0", "checkpoint.keep must be an integer >= 1, got 0."),
        ("checkpoint.interval=-1", "checkpoint.interval must be a number >= 0 or null, got -1."),
        ("checkpoint.max_share=0", "checkpoint.max_share must be a number > 0 and <= 1, got 0."),
        (
            "loss=grpo loss.clip_epsilon=[0.2,-1]",
            r"clip_epsilon\[1\] must be a number >= 0, got -1",
        ),
        ("ecac gamma=2", "gamma must be a number >= 0 and <= 1, got 2."),
        ("ecac polyak=0", "polyak must be a number > 0 and <= 1, got 0."),
        ("ecac replay_buffer.storage=tape", "must be tensor or memmap, got 'tape'."),
        ("ecac loss.projection=mean", "must be centred or paper or gradient, got 'mean'."),
        ("logger.backend=excel", "must be csv or tensorboard or wandb, got 'excel'."),
    ],
)
def test_what_is_wrong_is_named(options, message):
    script, given = split(options)
    with pytest.raises(ValueError, match=message):
        compose_options(SCRIPTS / script, given)


def compositions(script):
    """One for each choice."""
    for path in (SCRIPTS / script / "config").glob("[!s]*/*.yaml"):  # not the settings
        group = path.parent.name
        # loss.tau is the form's
        task = ["env=copy"] if script == "ecpo" and group in ("policy", "form") else []
        form = ["form=paper"] if script == "ecpo" and group == "loss" else []
        name = ["env.name=CartPole-v1"] if (script, path.stem) == ("ecac", "gym") else []
        yield [*task, *form, f"{group}={path.stem}", *name]


@pytest.mark.parametrize("script", ["ecpo", "ecac", "llm"])
def test_the_defaults_are_right_and_say_what_options_take(script):
    folder = SCRIPTS / script
    kinds, names = yaml.safe_load((folder / "options.yaml").read_text()), set()
    for given in compositions(script):
        config = compose_options(folder, given)
        entries = flatten(OmegaConf.to_container(config, resolve=True))
        names |= entries.keys()
        empty = {name for name, value in entries.items() if value == "None" and "ray" not in name}
        assert empty <= kinds.keys(), "null alone says nothing of what an option takes"
    unset = ("collector.backend_options", "stop_when.", "anneal_from.")
    optional = {name for name in kinds if name.startswith(unset)}
    former = {name for name, kind in kinds.items() if kind.startswith("now ")}
    assert kinds.keys() - optional - former <= names, "an option that no configuration has"
    assert {kinds[name].removeprefix("now ") for name in former} <= names | {"loss", "optim.lr"}


@pytest.mark.parametrize("script", ["ecpo", "ecac", "llm"])
def test_there_is_a_word_on_each_choice_and_each_option(script):
    configs, names, words = SCRIPTS / script / "config", set(), {"hydra"}
    for file in configs.rglob("*.yaml"):
        text = file.read_text()
        group = file.parent.relative_to(configs).parts[:1]
        is_shown = len(file.relative_to(configs).parts) == 2
        assert not is_shown or text.removeprefix("# @package _global_\n").startswith("# "), file
        parent = "" if "@package" in text or not group else f"{group[0]}."
        own = yaml.safe_load(text) or {}
        names |= {f"{parent}{name}" for name in flatten(own) if name != "defaults"}
        words |= {f"{parent}{name}" for name in words_of(file)}
    # Of an entry, or of what it is part of.
    told = {name for name in names if any(f"{name}.".startswith(f"{word}.") for word in words)}
    assert names == told


def test_help_comes_without_torch():
    """Which takes seconds; hydra and the configuration take less than one. Also after options."""
    code = """
import runpy, sys
sys.modules["torch"] = None  # importing it fails
sys.argv = [*sys.argv[1:], "--help"]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
    for script, *options in (("ecpo",), ("ecac", "env=minatar"), ("llm",)):
        path = SCRIPTS / script / f"{script}.py"
        command = [sys.executable, "-c", code, str(path), *options]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(path.parent), *sys.path])}
        process = subprocess.run(
            command, capture_output=True, text=True, check=False, env=environment
        )
        assert process.returncode == 0, process.stderr
        assert f"python {script}.py" in process.stdout
        rows = [line for line in process.stdout.splitlines() if line.startswith("  ")]
        assert len(rows) > 30
        assert all(len(row.split(maxsplit=1)) == 2 for row in rows), "a word on each"


@pytest.mark.parametrize(
    "options",
    [
        "optim.max_grad_norm=1 optim.lr=1 loss.tau=0 seed=999999",
        "env=copy anneal_from=null optim.max_grad_norm=null setting=[copy/ecpo,group_curriculum]",
        f"env=gym env.name=Acrobot-v1 loss=ecpo {SCHEDULE}",
        "collector=ray +collector.backend_options.ray_init_config.num_cpus=4",
        "ecac loss.target_kl=null loss.tau=0.1 optim.lr.log_tau=1e-3",
        "ecac loss.value_network=true hidden_sizes=[]",
        "env=copy loss=grpo loss.clip_epsilon=[0.2,0.28]",
        "hydra/launcher=joblib hydra.run.dir='a=b,c' resume='a=b'",
    ],
)
def test_what_is_right_is_composed_as_hydra_does(options):
    script, given = split(options)
    with initialize_config_dir(str(SCRIPTS / script / "config"), version_base="1.3"):
        assert compose_options(SCRIPTS / script, given) == compose("config", given)


def test_numbers_with_an_exponent_are_integers():
    stack = "stack=['loss=ecpo total_trajectories=2e3']"
    given = ["total_trajectories=1e4", "num_groups=2.0E+1", "loss.tau=1e-3", stack]
    config = compose_options(SCRIPTS / "ecpo", [*given, "hydra.run.dir='runs/1e4'"])
    assert repr(config.total_trajectories) == "10000"
    assert repr(config.num_groups) == "20"
    assert config.loss.tau == 0.001
    assert config.stack == ["loss=ecpo total_trajectories=2000"]


def test_hydra_s_own_refusals_stand():
    with pytest.raises(HydraException, match="An item is already at 'seed'"):
        compose_options(SCRIPTS / "ecpo", ["+seed=3"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("seed=0,1 loss.tau=0.1,fast --multirun", "ecpo.py: loss.tau must be .* got 'fast'"),
        ("-m loss=ecpo,rloo loss.control_variate=true", "no option loss.control_variate"),
        ("-cn config env=chess", "There is no env=chess; there are bandit, copy, deep_sea,"),
        ("--multirun seed=1,2", "ecpo.py: seed 2 is refused"),
        ("--multirun loss=glob(r*) seed=2", "ecpo.py: loss reps is refused"),
    ],
)
def test_all_runs_of_a_command_line_are_checked(monkeypatch, options, message):
    def check(config, given):
        if config.seed == 2:
            raise ValueError(f"{given[0].replace('=', ' ')} is refused")

    monkeypatch.setattr(sys, "argv", ["ecpo.py", *options.split()])
    with pytest.raises(SystemExit, match=message):
        check_command_line(str(SCRIPTS / "ecpo/ecpo.py"), check)


@pytest.mark.parametrize(
    "options", ["--cfg job env=chess", "-c job", "-p optim", "--info searchpath", "-cp config"]
)
def test_hydra_s_own_flags_are_its_own(monkeypatch, options):
    """What is only shown is not checked."""
    monkeypatch.setattr(sys, "argv", ["ecpo.py", *options.split()])
    check_command_line(str(SCRIPTS / "ecpo/ecpo.py"), lambda config, given: None)


@pytest.fixture
def refusal(beside, monkeypatch):
    """What a script says of options before it begins."""

    def refusal(options):
        script, given = split(options)
        module = beside(script, script)
        monkeypatch.setattr(sys, "argv", [f"{script}.py", *given])
        check = module.check_config if script == "ecac" else module.check_runs
        with pytest.raises(SystemExit) as refused:
            check_command_line(str(SCRIPTS / script / f"{script}.py"), check)
        return f"{refused.value}\n"

    return refusal


def test_all_that_does_not_go_together_is_said(refusal):
    said = ("compile=true is for single runs", "policy= is for the algorithmic tasks")
    lines = refusal("compile=true env=bandit +policy=window seeds=[0,1]").splitlines()
    assert all(line.startswith(f"ecpo.py: {one}") for line, one in zip(lines, said, strict=True))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("compile=true env=copy", "compile=true is for tasks of the kinds ('bandit', 'gym')"),
        ("stack=['seed=0','loss.tua=1']", "ecpo.py: There is no option loss.tua"),
        ("form=book", "ecpo.py: There is no form=book; there are paper, recipe.\n"),
        ("loss=grpo env=reverse form=paper", "with reverse/grpo it would change nothing"),
        ("env=deep_sea form=paper", "form=paper is for env= of bandit, copy"),
        ("stack=['loss=rloo'] form=paper", "with bandit/rloo it would change nothing"),
        ("loss=trust_pcl loss.delay_actor=true", "loss.delay_actor=true: the script moves no copy"),
        ("policy=lstm", "ecpo.py: Could not override 'policy'. No match in the defaults list.\n"),
        ("+policy=lstm", "ecpo.py: policy= is for the algorithmic tasks and env=popgym, got"),
        ("env=popgym policy=tables", "ecpo.py: policy.tables=true is for the algorithmic tasks"),
        ("env=algorithmic", "There is no env=algorithmic; there are bandit, copy"),
        ("ecac env=gym", "ecac.py: env.name must be given.\n"),
        (
            "env=bandit=1",
            "ecpo.py: env=bandit=1 cannot be read as NAME=VALUE: mismatched input '='",
        ),
        ("bandit seed=1", "ecpo.py: bandit cannot be read as NAME=VALUE: missing EQUAL at"),
        ("seed=1,2", "ecpo.py: seed=1,2 is several runs: add --multirun. A list is in brackets."),
        ("resume=nowhere", "ecpo.py: resume=nowhere: there is no such directory.\n"),
        ("hydra.job.chdir=false", "ecpo.py: hydra.job.chdir=false would write runs to the"),
        ("ecac loss=sac loss.actor=deterministic", "with loss=sac, whose policy is tanh_gaussian"),
        ("ecac loss=td3 loss.actor=tanh_gaussian", "with loss=td3, whose policy is deterministic"),
        (
            "ecac env=cartpole loss=discrete_sac loss.actor=deterministic",
            "loss=discrete_sac, whose policy is categorical",
        ),
    ],
)
def test_a_refusal_is_one_line(refusal, options, message):
    said = refusal(options)
    assert message in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("loss.control_variate=no", "ecpo.py: loss.control_variate must be true or false"),
        ("compile=true seeds=[0,1]", "ecpo.py: compile=true is for single runs"),
        ("env=copy policy=gru", "ecpo.py: There is no policy=gru; there are lstm, memory"),
        ("ecac --multirun gamma=0,2", "ecac.py: gamma must be a number >= 0 and <= 1, got 2."),
        # When the run has begun.
        (
            "collector=multi_sync",
            "ecpo.py: num_groups=1 must be a multiple of the number of workers",
        ),
    ],
)
def test_a_script_says_so_in_one_line_and_makes_no_directory(tmp_path, options, message):
    script, given = split(options)
    process = run_script(tmp_path, SCRIPTS / script / f"{script}.py", *given)
    assert process.returncode == 1
    assert message in process.stderr
    assert process.stderr.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {".stdout", ".stderr"}
