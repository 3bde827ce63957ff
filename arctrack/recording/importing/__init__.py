"""Raw files of a camera and a robot made into a recording: images, poses in any convention, conditions."""
