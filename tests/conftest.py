"""While the tests run, beartype checks every type in skinlib's signatures."""

from beartype import BeartypeConf
from beartype.claw import beartype_package

# An int is welcome where a signature says float, as in the rest of Python.
beartype_package("skinlib", conf=BeartypeConf(is_pep484_tower=True))
