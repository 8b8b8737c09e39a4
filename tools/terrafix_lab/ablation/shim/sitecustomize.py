"""Imported by every interpreter of a command before anything else: replaces the mechanism that VARIABLE names."""

import os

from terrafix_lab.ablation.mechanisms import MECHANISMS, VARIABLE

MECHANISMS[os.environ[VARIABLE]].replace()
