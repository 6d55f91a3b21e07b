"""The topics: the first frame of each message (docs/stream.md)."""

ESTIMATE = b"/taxeld/estimate"
PARTICLES = b"/taxeld/particles"
TAXELS = b"/taxeld/taxels"
CONTACTS = b"/taxeld/contacts"
COUNTS = b"/taxeld/counts"
HEALTH = b"/taxeld/health"
INFO = b"/taxeld/info"
TOPICS = (ESTIMATE, PARTICLES, TAXELS, CONTACTS, COUNTS, HEALTH, INFO)
SENSOR_POSE = b"/robot/sensor_pose"
