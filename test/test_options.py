"""What the scripts are asked for is checked before a run directory is made."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf
from processes import run_script

from torchrl_ecpo.experiment import check_command_line, compose_options
from torchrl_ecpo.experiment.run import flatten

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
        ("ecac +loss.tau=0.5", "no option loss.tau; the nearest one is loss.options.tau."),
        ("ecac +optim.lr=7", "no option optim.lr; the nearest one is loss.lr."),
        ("ecac loss=sac +loss.options.tau=1", "no option loss.options.tau"),
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
        ("env=gym env.hidden_sizes=64", "env.hidden_sizes must be a list, got 64."),
        ("env=gym env.hidden_sizes=[64,0]", r"hidden_sizes\[1\] must be an integer >= 1, got 0."),
        ("ecac loss.options.target_entropy=ayto", "must be a number or auto or null, got 'ayto'."),
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
        ("ecac gamma=2", "gamma must be a number >= 0 and <= 1, got 2."),
        ("ecac polyak=0", "polyak must be a number > 0 and <= 1, got 0."),
        ("ecac replay_buffer.storage=tape", "must be tensor or memmap, got 'tape'."),
        ("ecac loss.options.projection=mean", "must be centred or paper or gradient, got 'mean'."),
        ("logger.backend=excel", "must be csv or tensorboard or wandb, got 'excel'."),
    ],
)
def test_what_is_wrong_is_named(options, message):
    script, given = split(options)
    with pytest.raises(ValueError, match=message):
        compose_options(SCRIPTS / script, given)


@pytest.mark.parametrize("script", ["ecpo", "ecac"])
def test_the_defaults_are_right_and_say_what_options_take(script):
    folder = SCRIPTS / script
    kinds, names = yaml.safe_load((folder / "options.yaml").read_text()), set()
    for path in (folder / "config").glob("[!s]*/*.yaml"):  # not the settings
        if path.stem in ("algorithmic", "exploration", "gym"):
            continue  # incomplete
        group = path.parent.name
        task = ["env=copy"] if group in ("policy", "form") else []  # loss.tau is the form's
        form = ["form=paper"] if script == "ecpo" and group == "loss" else []
        config = compose_options(folder, [*task, *form, f"{group}={path.stem}"])
        entries = flatten(OmegaConf.to_container(config, resolve=True))
        names |= entries.keys()
        empty = {name for name, value in entries.items() if value == "None" and "ray" not in name}
        assert empty <= kinds.keys(), "null alone says nothing of what an option takes"
    optional = {name for name, kind in kinds.items() if kind.endswith("or nothing")}
    unset = ("collector.backend_options", "stop_when.")
    optional |= {name for name in kinds if name.startswith(unset)}
    assert kinds.keys() - optional <= names, "an option that no configuration has"


@pytest.mark.parametrize(
    "options",
    [
        "optim.max_grad_norm=1 optim.lr=1 loss.tau=0 seed=999999",
        "env=copy anneal_from=null optim.max_grad_norm=null setting=[copy/ecpo,group_curriculum]",
        f"env=gym env.name=Acrobot-v1 loss=ecpo {SCHEDULE}",
        "collector=ray +collector.backend_options.ray_init_config.num_cpus=4",
        "ecac loss.options.target_kl=null loss.options.tau=0.1 ~loss.lr.log_tau",
        "ecac loss.value_network=true +loss.lr.value_network=3e-4 hidden_sizes=[]",
        "hydra/launcher=joblib hydra.run.dir='a=b,c' resume='a=b'",
    ],
)
def test_what_is_right_is_composed_as_hydra_does(options):
    script, given = split(options)
    with initialize_config_dir(str(SCRIPTS / script / "config"), version_base="1.3"):
        assert compose_options(SCRIPTS / script, given) == compose("config", given)


def test_hydra_s_own_refusals_stand():
    with pytest.raises(HydraException, match="An item is already at 'seed'"):
        compose_options(SCRIPTS / "ecpo", ["+seed=3"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("seed=0,1 loss.tau=0.1,fast --multirun", "ecpo.py: loss.tau must be .* got 'fast'"),
        ("-m loss=ecpo,rloo loss.control_variate=true", "no option loss.control_variate"),
        ("-cn config env=chess", "Could not find 'env/chess'"),
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("loss.control_variate=no", "ecpo.py: loss.control_variate must be true or false"),
        ("compile=true seeds=[0,1]", "ecpo.py: compile=true is for single runs"),
        ("compile=true env=copy", "compile=true is for tasks of the kinds ('bandit', 'gym')"),
        ("stack=['seed=0','loss.tua=1']", "ecpo.py: There is no option loss.tua"),
        ("env=copy policy=gru", "Could not find 'policy/gru' Available options in 'policy': lstm"),
        ("form=book", "Could not find 'form/book' Available options in 'form': paper recipe"),
        ("policy=lstm", "ecpo.py: Could not override 'policy'. No match in the defaults list.\n"),
        ("+policy=lstm", "ecpo.py: policy= is for the algorithmic tasks and env=popgym, got"),
        (
            "env=popgym policy=tables",
            "ecpo.py: policy.tables=true is for the algorithmic tasks",
        ),
        ("ecac --multirun gamma=0,2", "ecac.py: gamma must be a number >= 0 and <= 1, got 2."),
        ("ecac log_interval=70", "evaluation.interval must be a multiple of log_interval"),
        ("ecac total_frames=200", "total_frames must be a multiple of log_interval, or the last"),
    ],
)
def test_a_script_says_so_in_one_line_and_makes_no_directory(tmp_path, options, message):
    script, given = split(options)
    process = run_script(tmp_path, SCRIPTS / script / f"{script}.py", *given)
    assert process.returncode == 1
    assert message in process.stderr
    assert process.stderr.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {".stdout", ".stderr"}
