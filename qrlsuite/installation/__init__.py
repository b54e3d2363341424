"""Tests of the installation, for `qrlsuite doctor`."""
