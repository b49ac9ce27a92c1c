"""PyBullet behind the protocols of `world`; the only folder that imports it."""
