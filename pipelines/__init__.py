"""The steps from photos to a report, one file each.

:mod:`pipelines.graph` joins them, :mod:`pipelines.app` runs them, :mod:`pipelines.cli` is the command line.
"""
