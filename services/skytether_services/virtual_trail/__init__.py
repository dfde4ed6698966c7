"""The service ``virtual-trail``: guides a person with a smart walker along a trail (thesis 2.5.1, 3.3).

The person gives the pace by pushing; the service turns the walker so that it stays on the trail. `service` is the
shell; the loop is in `guide`, its parts are pure: `path`, `follower`, `odometry`, `filter`, and the law that it shares
with the robot's own fallback, `skytether.control.admittance`.
"""
