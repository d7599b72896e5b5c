"""Films of episodes and figures of learning curves."""

from latentplan.config.extras import require_extra

require_extra("latentplan.reporting", "cv2", "matplotlib")
