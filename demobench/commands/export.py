"""`demobench export`: one network of a trained policy as an ONNX file. What does not belong here: how (`pipeline.export`)."""

from dataclasses import asdict
from pathlib import Path

from rich.markup import escape

from demobench.commands.session import open_session, write_json_to
from demobench.commands.trained import find_trained
from pipeline.errors import ConfigError


def run_export(
    address: str, out: Path, *, seed: int, config_path: Path | None, store_path: str | None, json_to: str | None
) -> None:
    """Write one network of fold 0 to a file.

    Raises
    ------
    ConfigError : the address names nothing, or several policies, or there is no such seed.
    NotApplicableError : the policy is no network that can be exported.
    """
    from pipeline.export import export_policy
    from pipeline.folds import load_fold
    from pipeline.train import weights_hash

    session = open_session(config_path, store_path, json_to)
    found = find_trained(address, session)
    names = [one.variant.name for one in found]
    if len(found) > 1:
        raise ConfigError(f"'{address}' stands for several policies: {', '.join(names)}. Export one of them.")
    if out.suffix != ".onnx" or not out.parent.is_dir():
        raise ConfigError(
            f"'{out}' is no place for an ONNX file. Name one that ends in .onnx, in a folder that exists."
        )
    one = found[0]
    policy = load_fold(one.task, one.folder, 0)
    if seed not in policy.seeds:
        raise ConfigError(f"{names[0]} has no seed {seed}. Its seeds are {', '.join(map(str, policy.seeds))}.")
    said = {"key": one.plan.key, "fingerprint": one.fingerprint, "weights_sha256": weights_hash(one.folder / "fold_0")}
    made = export_policy(one.task, policy.one_seed(policy.seeds.index(seed)), out, said)
    if json_to != "-":
        inputs = ", ".join(f"{name} {list(shape)}" for name, shape in made.inputs.items())
        session.console.print(
            f"{escape(str(out))}: {inputs} → actions {list(made.output)}, float32, raw units; {made.bytes / 1e6:.1f} MB, opset "
            f"{made.metadata['opset']}. Over {made.compared} held-out windows it is at most {made.most_off:.2g} off what PyTorch "
            "answers.",
            soft_wrap=True,
        )
    write_json_to(json_to, {"file": str(out), **asdict(made)})
