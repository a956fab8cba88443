"""Humans from photographs: fitting of a body to calibrated views, and textures from them."""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.photographs.fit_file import read_fit as read_fit
    from humansim_ros.photographs.fit_file import write_fit as write_fit
    from humansim_ros.photographs.fitting import fit_person as fit_person
    from humansim_ros.photographs.person_fit import PersonFit as PersonFit
    from humansim_ros.photographs.person_fit import Proportions as Proportions
    from humansim_ros.photographs.person_fit import fit_motion as fit_motion
    from humansim_ros.photographs.person_fit import with_proportions as with_proportions
    from humansim_ros.photographs.surface import TexturedPerson as TexturedPerson
    from humansim_ros.photographs.texturing import texture_person as texture_person
    from humansim_ros.photographs.views import Photo as Photo
    from humansim_ros.photographs.views import PhotoSet as PhotoSet
    from humansim_ros.photographs.views import read_views as read_views

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "PersonFit": "person_fit",
        "Photo": "views",
        "PhotoSet": "views",
        "Proportions": "person_fit",
        "TexturedPerson": "surface",
        "fit_motion": "person_fit",
        "fit_person": "fitting",
        "read_fit": "fit_file",
        "read_views": "views",
        "texture_person": "texturing",
        "with_proportions": "person_fit",
        "write_fit": "fit_file",
    },
)
