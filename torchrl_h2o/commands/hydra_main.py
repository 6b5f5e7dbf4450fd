"""The decorator of the scripts: ``hydra.main`` that checks the options, and ends expected errors with one line."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig

from torchrl_h2o.commands.one_line_errors import FULL_ERROR, asks_for_tracebacks, one_line_errors
from torchrl_h2o.commands.wrong_override import in_words
from torchrl_h2o.options import Options, check_options

Job = Callable[[DictConfig], None]


def hydra_main(config_path: str, config_name: str, options: type[Options]) -> Callable[[Job], Callable[[], None]]:
    """Returns a decorator that does what ``hydra.main`` does, and ends expected errors with one line and status 1.

    The options are checked before the decorated function is called, and a job that fails leaves no empty folder.
    Expected errors are a wrong path, option or layout of a log, see
    :func:`~torchrl_h2o.commands.one_line_errors.is_expected`. HYDRA_FULL_ERROR=1 shows their traceback. In a multirun,
    Hydra and its launcher handle all errors except those of options.

    Args:
        config_path: folder of the configuration, relative to the file of the decorated function.
        config_name: name of the configuration file, without its ending.
        options: types and bounds of the options.

    Examples:
        >>> from torchrl_h2o.options import CloseTheLoopOptions
        >>> @hydra_main(config_path="../config", config_name="close_the_loop", options=CloseTheLoopOptions)
        ... def main(cfg):
        ...     raise ValueError(f"data={cfg.data}: choose another")
        >>> main.__name__
        'main'
    """

    def decorate(function: Job) -> Callable[[], None]:
        hydra_raises = False  # whether HYDRA_FULL_ERROR was set here, and not by the user

        @functools.wraps(function)
        def job(cfg: DictConfig) -> None:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                with one_line_errors(), _no_empty_folder():
                    check_options(cfg, options)
                return function(cfg)
            if hydra_raises:
                os.environ.pop(FULL_ERROR, None)  # child processes and unexpected errors are not concerned
            with one_line_errors(), _no_empty_folder():
                check_options(cfg, options)
                return function(cfg)

        run = hydra.main(config_path=config_path, config_name=config_name, version_base=None)(job)

        @functools.wraps(function)
        def main() -> None:
            nonlocal hydra_raises
            if asks_for_tracebacks() or {"--multirun", "-m"} & set(sys.argv):
                return run()
            with one_line_errors():
                # otherwise Hydra prints its errors in several lines and exits
                hydra_raises, os.environ[FULL_ERROR] = True, "1"
                try:
                    return run()
                except HydraException as error:
                    raise ValueError(in_words(error)) from error
                finally:
                    os.environ.pop(FULL_ERROR, None)

        return main

    return decorate


@contextmanager
def _no_empty_folder() -> Iterator[None]:
    """Removes the folder that Hydra has made for the job, if the job fails before it writes anything."""
    try:
        yield
    except Exception:
        folder, here = Path(HydraConfig.get().runtime.output_dir), Path.cwd()
        while folder != here and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
            if here not in folder.parents:  # the parents of a folder elsewhere are the user's
                break
            folder = folder.parent
        raise
