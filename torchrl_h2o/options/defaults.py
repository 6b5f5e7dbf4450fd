"""Default values of the options as configurations of Hydra, and the text of ``--help``, both from the models."""

from __future__ import annotations

from hydra.core.config_store import ConfigStore

from torchrl_h2o.options.types import Options
from torchrl_h2o.options.words import allowed, as_typed

HELP = """${{hydra.help.header}}
Groups, as group=name:
$APP_CONFIG_GROUPS
Options, as name=value:
{options}

With these groups:
$CONFIG
${{hydra.help.footer}}"""


def store_defaults(name: str, model: type[Options]) -> None:
    """Makes the default values of a model, and their help as ``hydra/help``, available to a configuration file.

    Args:
        name: name in the defaults list.
        model: options. Those without a default are ``???``: they must be given, by a file or on the command line.

    Examples:
        >>> from torchrl_h2o.options import EvaluateOptions
        >>> store_defaults("evaluate_options", EvaluateOptions)
        >>> ConfigStore.instance().load("evaluate_options.yaml").node.episodes
        5
    """
    required = {field.alias or key: "???" for key, field in model.model_fields.items() if field.is_required()}
    store = ConfigStore.instance()
    store.store(name, required | model.model_construct().model_dump(by_alias=True))
    template = HELP.format(options=described(model))
    text = {"app_name": "${hydra.job.name}", "header": "", "footer": "", "template": template}
    store.store(name, text, group="hydra/help")


def described(model: type[Options]) -> str:
    """Returns one line for each option: its default value, its meaning, and what is allowed.

    Examples:
        >>> from torchrl_h2o.options import EvaluateOptions
        >>> print(described(EvaluateOptions).splitlines()[4])
        seed=1000000: the default gives the same episodes as the table of the run (an integer from 0 to 4294967295)
    """
    schema, lines = model.model_json_schema(), []
    for name, entry in schema["properties"].items():
        if "$ref" in entry:  # a group of options, such as env, which files of its own describe
            continue
        default = f"={as_typed(entry['default'])}" if entry.get("default", "???") != "???" else ""
        meaning = f" {entry['help']}" if entry.get("help") else ""
        lines.append(f"{name}{default}:{meaning} ({allowed(entry)})")
    return "\n".join(lines)
