"""Public captures, brought by name: what there is, from where, under which licence. Nothing is trained here."""
