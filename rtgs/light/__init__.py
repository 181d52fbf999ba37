"""Light by direction: cubemaps, their prefilter, maps of features, pictures. Pure functions; methods train them."""
