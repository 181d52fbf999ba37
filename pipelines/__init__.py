"""The steps from photos to a report, one file each; :mod:`pipelines.graph` joins them, ``pipelines.run`` runs them."""
