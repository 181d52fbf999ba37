"""Experiments behind defaults and negative results; docs/lab holds their tables. Nothing else imports them."""
