"""Version 1 of the schema: messages in ``tracking_pb2``, service in ``tracking_pb2_grpc``."""
