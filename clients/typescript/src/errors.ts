/**
 * Errors of the service: one class per name with its HTTP status. The names, their order and their inheritance are those of the
 * Python package `ddakf_api.errors`; `protos/vectors/errors.json` keeps both equal.
 */
import type { ErrorDetail } from "./gen/ddakf_api/v1/tracking_pb.js";

/** The parts of an error, with the names of `ErrorDetail`. */
export interface ErrorParts {
  /** The invalid field, e.g. `point_cloud.data`; may be empty. */
  field?: string;
  /** Description of valid values. */
  expected?: string;
  /** Description of the received value. */
  got?: string;
  /** Seconds after which a retry makes sense; 0: unknown. */
  retryAfter?: number;
}

/** Base of all errors that the service or this client raises deliberately. */
export class ServiceError extends Error {
  /** Name on the wire. A field of its own, because minifiers shorten the names of classes. */
  static readonly wireName: string = "ServiceError";
  static readonly httpStatus: number = 500;
  /** The same request may succeed later. */
  static readonly retryable: boolean = false;

  readonly field: string;
  readonly expected: string;
  readonly got: string;
  readonly retryAfter: number;
  /** Sequence number of the frame, if the error is of a frame. */
  sequence?: number;

  constructor(message: string, parts: ErrorParts = {}) {
    const { field = "", expected = "", got = "", retryAfter = 0 } = parts;
    super(message || `${field}: expected ${expected}, got ${got}`);
    this.name = new.target.wireName;
    this.field = field;
    this.expected = expected;
    this.got = got;
    this.retryAfter = retryAfter;
  }
}

/** An invalid input; no state was changed. */
export class InvalidArgument extends ServiceError {
  static override readonly wireName: string = "InvalidArgument";
  static override readonly httpStatus: number = 422;
}

/** A mesh that cannot serve as a garment or body. */
export class InvalidMesh extends InvalidArgument {
  static override readonly wireName: string = "InvalidMesh";
}

/** A frame with invalid points, time, origin or body. */
export class InvalidFrame extends InvalidArgument {
  static override readonly wireName: string = "InvalidFrame";
}

/** Points that cannot be encoded, or data that cannot be decoded within the limits. */
export class CodecError extends InvalidFrame {
  static override readonly wireName: string = "CodecError";
}

/** A configuration value outside its range, or an unknown field. */
export class InvalidConfig extends InvalidArgument {
  static override readonly wireName: string = "InvalidConfig";
}

/** A file of another format or content than its name or use requires. */
export class InvalidFile extends InvalidArgument {
  static override readonly wireName: string = "InvalidFile";
}

/** Data that is no snapshot of a tracker, or one of an unknown version. */
export class InvalidSnapshot extends InvalidArgument {
  static override readonly wireName: string = "InvalidSnapshot";
}

/** No API key, or an unknown one. */
export class Unauthenticated extends ServiceError {
  static override readonly wireName: string = "Unauthenticated";
  static override readonly httpStatus: number = 401;
}

/** The scopes of the API key do not allow the call, or the page's origin is not allowed. */
export class PermissionDenied extends ServiceError {
  static override readonly wireName: string = "PermissionDenied";
  static override readonly httpStatus: number = 403;
}

/** The session does not exist, or no longer exists. */
export class SessionNotFound extends ServiceError {
  static override readonly wireName: string = "SessionNotFound";
  static override readonly httpStatus: number = 404;
}

/** The session exceeded its idle timeout or its lifetime. */
export class SessionExpired extends SessionNotFound {
  static override readonly wireName: string = "SessionExpired";
  static override readonly httpStatus: number = 410;
}

/** The requested session id is in use. */
export class SessionExists extends ServiceError {
  static override readonly wireName: string = "SessionExists";
  static override readonly httpStatus: number = 409;
}

/** The state does not allow the call: messages in the wrong order, or an update of a changed resource. */
export class FailedPrecondition extends ServiceError {
  static override readonly wireName: string = "FailedPrecondition";
  static override readonly httpStatus: number = 409;
}

/** The session already has a stream; `takeover` ends that stream. */
export class SessionBusy extends ServiceError {
  static override readonly wireName: string = "SessionBusy";
  static override readonly httpStatus: number = 409;
}

/** Client and server have incompatible API versions. */
export class VersionMismatch extends ServiceError {
  static override readonly wireName: string = "VersionMismatch";
  static override readonly httpStatus: number = 400;
}

/** Another client took over the session of this stream. */
export class StreamTakenOver extends ServiceError {
  static override readonly wireName: string = "StreamTakenOver";
  static override readonly httpStatus: number = 409;
}

/** The server, the API key or the session has reached a limit. */
export class ResourceExhausted extends ServiceError {
  static override readonly wireName: string = "ResourceExhausted";
  static override readonly httpStatus: number = 429;
  static override readonly retryable: boolean = true;
}

/** A request with more bytes than the server accepts. */
export class MessageTooLarge extends ResourceExhausted {
  static override readonly wireName: string = "MessageTooLarge";
  static override readonly httpStatus: number = 413;
  static override readonly retryable: boolean = false;
}

/** A frame that exceeded its limit of processor time, or the end of a session that has sent too many of them. */
export class FrameTooCostly extends ServiceError {
  static override readonly wireName: string = "FrameTooCostly";
  static override readonly httpStatus: number = 429;
}

/** The server does not answer, or is not ready. */
export class Unavailable extends ServiceError {
  static override readonly wireName: string = "Unavailable";
  static override readonly httpStatus: number = 503;
  static override readonly retryable: boolean = true;
}

/** The session's worker process died. Repeat a refused frame or call; after the end of a stream create the session again. */
export class WorkerLost extends ServiceError {
  static override readonly wireName: string = "WorkerLost";
  static override readonly httpStatus: number = 503;
  static override readonly retryable: boolean = true;
}

/** The server is shutting down and accepts no new work. */
export class Draining extends ServiceError {
  static override readonly wireName: string = "Draining";
  static override readonly httpStatus: number = 503;
  static override readonly retryable: boolean = true;
}

/** No answer within the timeout of the caller. */
export class DeadlineExceeded extends ServiceError {
  static override readonly wireName: string = "DeadlineExceeded";
  static override readonly httpStatus: number = 504;
}

/** One side ended the call before it was complete. */
export class Cancelled extends ServiceError {
  static override readonly wireName: string = "Cancelled";
  static override readonly httpStatus: number = 499;
}

/** The contract has the feature, this server does not. */
export class Unimplemented extends ServiceError {
  static override readonly wireName: string = "Unimplemented";
  static override readonly httpStatus: number = 501;
}

/** A defect of the server; its log has the details. */
export class Internal extends ServiceError {
  static override readonly wireName: string = "Internal";
}

/** No such mesh of the key, or no such address on the HTTP port. */
export class NotFound extends ServiceError {
  static override readonly wireName: string = "NotFound";
  static override readonly httpStatus: number = 404;
}

/** The address has other methods; `Allow` names them. HTTP only. */
export class MethodNotAllowed extends ServiceError {
  static override readonly wireName: string = "MethodNotAllowed";
  static override readonly httpStatus: number = 405;
}

/**
 * Error classes by wire name. The first class of an HTTP status is the default for that status. Pure: a bundle that does not look
 * errors up, such as that of the worker, has only the classes that it throws.
 */
export const ERRORS: ReadonlyMap<string, typeof ServiceError> = /* @__PURE__ */ new Map(
  /* @__PURE__ */ [
    ...[InvalidArgument, InvalidMesh, InvalidFrame, CodecError, InvalidConfig, InvalidFile, InvalidSnapshot],
    ...[Unauthenticated, PermissionDenied, SessionNotFound, SessionExpired, SessionExists, FailedPrecondition],
    ...[
      SessionBusy,
      VersionMismatch,
      StreamTakenOver,
      ResourceExhausted,
      MessageTooLarge,
      FrameTooCostly,
      Unavailable,
      WorkerLost,
    ],
    ...[Draining, DeadlineExceeded, Cancelled, Unimplemented, Internal, NotFound, MethodNotAllowed],
  ].map((cls) => [cls.wireName, cls]),
);

/** The fields of an error as the wire has them: a message of the contract, or JSON over HTTP. */
export type WireError = Partial<Pick<ErrorDetail, "name" | "field" | "expected" | "got" | "message" | "retryAfter">>;

/** The exception of an error on the wire. An unknown name, of a later version, gives {@link ServiceError} itself. */
export function fromDetail(detail: WireError): ServiceError {
  const name = detail.name ?? "";
  const cls = ERRORS.get(name) ?? ServiceError;
  return new cls(detail.message || name, detail);
}

/** The exception of an HTTP status, or of a WebSocket's close code less 4000, that came without an `ErrorDetail`. */
export function fromStatus(status: number, message: string): ServiceError {
  const cls = [...ERRORS.values()].find((each) => each.httpStatus === status) ?? Internal;
  return new cls(message || `the server answered ${status}`);
}
