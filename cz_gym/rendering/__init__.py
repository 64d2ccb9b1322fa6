"""Pictures of a growing crystal: what ``render_mode`` shows, what :mod:`cz_gym.play` and :mod:`studies.film` draw.

Everything here reads an episode and never changes it. Drawing needs pygame (the extra ``render``), and a display only
for windows; importing needs neither.
"""
