"""Interactive viewer of a trained surrogate in the browser."""

from typing import TYPE_CHECKING

from dpl.system.lazy import public_names

if TYPE_CHECKING:
    from dpl.viewer.access import AccessPolicy
    from dpl.viewer.frames import Body
    from dpl.viewer.page import Page
else:
    __all__, __getattr__, __dir__ = public_names(__name__)
