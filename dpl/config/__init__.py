"""Configurations: checked, built into scenes and networks, kept in the folder of a run."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.config.build import (
        build_scene,
        build_surrogate,
        build_trainer,
        instantiate,
        show_plan,
    )
    from dpl.config.plain import (
        check,
        error_in,
        files_of_run,
        hyperparameters,
        options_of_run,
        to_container,
    )
    from dpl.config.resume import (
        check_callbacks,
        check_resumed,
        check_weights,
        resumed_config,
        save_config,
        with_files_of_resumed,
    )
    from dpl.config.run_folder import (
        PREDICTION,
        load_data,
        load_run,
        with_copied_files,
    )
    from dpl.config.validation import ConfigError, Keys
    from dpl.version import CONF
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
