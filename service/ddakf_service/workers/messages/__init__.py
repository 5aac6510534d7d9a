"""Messages between the server and its workers: wire format, and the contract's messages in terms of the tracker."""
