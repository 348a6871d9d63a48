/* hbp.h: the device side of HBP 1.1, the Hall Bench Protocol (protocol/SPEC.md), in C99. This comment is the manual.
 *
 * WHAT.  Copy hbp.h, hbp_way.h, hbp.c and hbp_capture.c into a firmware (for CAN hbp_can.h and hbp_can.c, for means hbp_means.c, too), and
 * a motor drive answers `bench`: identity, parameters, states and watchdog, samples at the PWM rate, timestamped Hall edges, events,
 * captures. No heap, no operating system, no library but memcpy and memset. Proved by `bench conform`.
 *
 * MEMORY.  The caller owns all of it: one `struct hbp_link` for each serial port, USB or TCP connection, one `struct hbp` for each
 * device behind it (one, as a rule). Their size follows from the options below; `docs/firmware.md` has figures.
 *
 * USE.  What the drive is stands in constant tables; what it does, in a few functions of the application. Here power_stage, ticks, timer and
 * the like are the application's own.
 *
 *     struct sample { int16_t i_a, i_b; uint8_t hall; };                    // what the PWM interrupt measures
 *     static struct sample sample;
 *     static float n_p = 4.0f, i_max = 8.0f, omega_m_max = 300.0f;
 *
 *     static const struct hbp_channel channels[] = {
 *         {1, HBP_RAW_I16, HBP_UNIT_A, 0, offsetof(struct sample, i_a), 1.0f / 1024, 0.0f, "i_a"},
 *         {2, HBP_RAW_I16, HBP_UNIT_A, 0, offsetof(struct sample, i_b), 1.0f / 1024, 0.0f, "i_b"},
 *         {3, HBP_RAW_U8, HBP_UNIT_NONE, 0, offsetof(struct sample, hall), 1.0f, 0.0f, "hall"},
 *     };
 *     static const struct hbp_parameter parameters[] = {
 *         {1, HBP_UNIT_NONE, HBP_FLAG_READ_ONLY | HBP_FLAG_WHOLE, 1.0f, 32.0f, 4.0f, &n_p, "n_p"},
 *         {2, HBP_UNIT_A, 0, 0.5f, 20.0f, 8.0f, &i_max, "i_max"},
 *         {3, HBP_UNIT_RAD_PER_S, HBP_FLAG_IDLE_ONLY, 1.0f, 600.0f, 300.0f, &omega_m_max, "omega_m_max"},
 *     };
 *
 *     static uint16_t enter(void *user, uint8_t state, float *detail)
 *     {
 *         (void)user, (void)detail;
 *         power_stage(state == HBP_STATE_RUNNING);
 *         return 0;
 *     }
 *     static uint16_t setpoint(void *user, uint8_t mode, float value, float value2, float *detail)
 *     {
 *         (void)user, (void)value2;
 *         *detail = mode;
 *         if (mode != HBP_MODE_SPEED) return HBP_ERROR_NOT_SUPPORTED;
 *         *detail = omega_m_max;
 *         if (value > omega_m_max || value < -omega_m_max) return HBP_ERROR_OUT_OF_RANGE;
 *         use_speed(value);
 *         return 0;
 *     }
 *     static uint8_t outputs_on(void *user)
 *     {
 *         (void)user;
 *         return power_stage_is_on();
 *     }
 *
 *     static const struct hbp_config config = {
 *         .node = 1, .role = HBP_ROLE_DRIVE, .features = HBP_FEATURE_EDGES, .tick_hz = 170000000, .pwm_hz = 20000,
 *         .tick0 = FIRST_TICK,  // of the timer at the first call of hbp_tick
 *         .name = "my drive", .firmware = "1.0", .serial = "0123456789abcdef01234567", .build = "1a2b3c4",
 *         .channels = channels, .n_channels = 3, .sample_bytes = sizeof(struct sample),
 *         .parameters = parameters, .n_parameters = 3,
 *         .enter = enter, .setpoint = setpoint, .outputs_on = outputs_on,
 *     };
 *     static struct hbp_link link_;
 *     static struct hbp drive;
 *
 *     int main(void)
 *     {
 *         hbp_link_init(&link_, 0.0f);                                      // bytes/s that it carries: baud / 10; 0 for USB
 *         if (hbp_add(&link_, &drive, &config, random_number())) return 1;  // look at what it returns; another boot_id at each boot
 *         for (;;) {
 *             const uint8_t *bytes;
 *             size_t n = uart_received(&bytes);                             // cut anywhere
 *             hbp_rx(&link_, ticks(), bytes, n);
 *             hbp_poll(&link_, ticks());                                    // at least once a millisecond
 *             n = hbp_tx_peek(&link_, &bytes);                              // these two from the DMA's interrupt, if you like
 *             hbp_tx_advance(&link_, uart_send(bytes, n));
 *         }
 *     }
 *     void pwm_interrupt(void)
 *     {
 *         measure_and_control(&sample);
 *         if (!hbp_may_run(&drive, timer())) power_stage(0);                // the host is gone, or main() hangs
 *         hbp_tick(&drive, &sample);
 *     }
 *     void capture_interrupt(void)
 *     {
 *         hbp_edge(&drive, captured(), code_before(), code_after(), encoder());
 *     }
 *
 * A whole program of this kind is examples/posix.c.
 *
 * CAPTURE.  Where the configuration gives memory (`capture`), samples and edges are held in it and frozen by a trigger, as a host asks, or by
 * a fault without being asked: chapter 19 of SPEC, and docs/firmware.md. The memory is two rings, in which hbp_tick and hbp_edge write; from
 * the end of a capture on it is the main loop's. Call hbp_raise before hbp_tick, and the record of that period is that of the fault.
 *
 * WHO MAY CALL WHAT.  There are no locks; each queue has one writer and one reader.
 *   - main loop: hbp_link_init, hbp_add, hbp_rx, hbp_poll, hbp_fault, hbp_log. Only these call the application's functions.
 *   - PWM interrupt: hbp_tick, hbp_may_run, hbp_raise.
 *   - capture interrupt, of the same priority or a higher one, or the PWM interrupt before hbp_tick: hbp_edge.
 *   - one place, main loop or an interrupt: hbp_tx_peek, hbp_tx_advance.
 * All edges up to a sample's tick must be given before that sample, and all up to `now` before hbp_poll. Interrupts are those of the
 * core that runs the main loop, and 32-bit loads and stores are whole.
 *
 * TIME OF THE INTERRUPTS.  hbp_tick copies the chosen channels of each running stream: on a Cortex-M4, compiled for size, 47 instructions, 45
 * for each running stream of samples and 17 for each of its channels; 100 more (divisions) when a stream has just started. hbp_edge takes 53,
 * hbp_may_run 16 and hbp_raise 22. While a capture waits hbp_tick takes 40 more, and the copying of its record, and hbp_edge 101 in all. CRC
 * and COBS are the main loop's. Means (HBP_MEANS) take 55 for each channel of whole numbers and 130 for each f32, in the period of a record
 * 290 and 640. `python -m tests.protocol.c.sizes` measures them.
 *
 * WHAT IS LOST IS COUNTED.  Samples wait in blocks, one being filled by the interrupt, until the transmit queue has room. A block that
 * finds no free place is dropped whole, and counted: `tx_dropped`, the gap in `seq`, OVERRUN.
 */
#ifndef HBP_H
#define HBP_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* ---- options: on the command line, or in a file named by -DHBP_OPTIONS='"my_options.h"' -------------------------------------
 *
 * They make the size of the structures below: they must be the same for every file that includes this one, hbp.c too.
 */

#ifdef HBP_OPTIONS
#include HBP_OPTIONS
#endif
#ifndef HBP_RX_MAX
#define HBP_RX_MAX 128 /* payload of the largest request, 128 to 1024: CAPTURE_ARM has 22 bytes and 2 for each channel */
#endif
#ifndef HBP_TX_MAX
#define HBP_TX_MAX 256 /* payload of the largest frame sent, 128 to 1024 */
#endif
#ifndef HBP_TX_BYTES
#define HBP_TX_BYTES 1024 /* transmit queue of a link: a power of two, 2 * (HBP_TX_MAX + 24) at least */
#endif
#ifndef HBP_CHANNELS
#define HBP_CHANNELS 16 /* channels of a device, at most */
#endif
#ifndef HBP_POOLS
#define HBP_POOLS 2 /* streams of samples that a device can have at once, 1 to 4 */
#endif
#ifndef HBP_POOL_BYTES
#define HBP_POOL_BYTES 640 /* room for the blocks of one: a multiple of 4, 2 * (HBP_TX_MAX + 4) at least */
#endif
#ifndef HBP_EDGES
#define HBP_EDGES 16 /* Hall edges that can wait, a power of two */
#endif
#ifndef HBP_HOSTS
#define HBP_HOSTS 1 /* hosts on a CAN bus that are told apart; one on any other link */
#endif
#ifndef HBP_CRC_TABLE
#define HBP_CRC_TABLE 16 /* entries of 4 bytes: 16, or 256, which is twice as quick */
#endif
#ifndef HBP_CAPTURE
#define HBP_CAPTURE 1 /* 1: with hbp_capture.c, which holds samples and edges in memory that the configuration gives; 0: without */
#endif
#ifndef HBP_WAVEFORM
#define HBP_WAVEFORM 1 /* 1: hosts can write samples of a test signal into memory that the configuration gives; 0: they cannot */
#endif
#ifndef HBP_MEANS
#define HBP_MEANS 0 /* 1: with hbp_means.c, streams of means, for links that are too slow for samples (set HBP_FEATURE_MEANS); 0: without */
#endif
#ifndef HBP_CAPTURE_PART
#define HBP_CAPTURE_PART 256 /* bytes of a frozen capture of which hbp_poll makes the CRC at a time */
#endif
#ifndef HBP_BARRIER
#if defined(__GNUC__)
#define HBP_BARRIER() __atomic_thread_fence(__ATOMIC_SEQ_CST)
#else
#error "define HBP_BARRIER(): what keeps the compiler and the core from moving memory accesses past it"
#endif
#endif

/* ---- the numbers of SPEC ------------------------------------------------------------------------------------------------- */

/* <codes> by tests/protocol/make_spec.py, from the table that SPEC.md's are made of */
enum {
    HBP_TYPE_HELLO = 0x01,
    HBP_TYPE_TIME_SYNC = 0x02,
    HBP_TYPE_HEARTBEAT = 0x04,
    HBP_TYPE_ALIVE = 0x05,
    HBP_TYPE_BLOB_READ = 0x10,
    HBP_TYPE_PARAM_GET = 0x11,
    HBP_TYPE_PARAM_SET = 0x12,
    HBP_TYPE_PARAM_COMMIT = 0x13,
    HBP_TYPE_BLOB_WRITE = 0x14,
    HBP_TYPE_STATE_CMD = 0x20,
    HBP_TYPE_SETPOINT = 0x21,
    HBP_TYPE_STREAM_SET = 0x30,
    HBP_TYPE_STREAM_START = 0x31,
    HBP_TYPE_STREAM_STOP = 0x32,
    HBP_TYPE_STREAM_GET = 0x33,
    HBP_TYPE_CAPTURE_ARM = 0x38,
    HBP_TYPE_CAPTURE_STATUS = 0x39,
    HBP_TYPE_DATA = 0x40,
    HBP_TYPE_EDGES = 0x41,
    HBP_TYPE_EVENT = 0x42,
    HBP_TYPE_LOG = 0x43,
};

enum {
    HBP_ROLE_DRIVE = 1,
    HBP_ROLE_LOAD = 2,
};

enum {
    HBP_FEATURE_EDGES = 1, /* timestamped Hall edges can be streamed */
    HBP_FEATURE_COMMIT = 2, /* parameters can be stored for the next boot */
    HBP_FEATURE_SIMULATED = 4, /* no hardware moves */
    HBP_FEATURE_CAPTURE = 8, /* samples are held in the device's memory and frozen by a trigger (chapter 19) */
    HBP_FEATURE_COMMISSION = 16, /* modes without a sensor, and test signals (chapter 20) */
    HBP_FEATURE_MEANINGS = 32, /* blob 3 tells what parameters and channels mean */
    HBP_FEATURE_WAVEFORM = 64, /* blob 4 takes the samples of a test signal (chapter 20) */
    HBP_FEATURE_MEANS = 128, /* the stream event MEAN */
};

enum {
    HBP_STATE_BOOT = 0,
    HBP_STATE_IDLE = 1,
    HBP_STATE_ARMED = 2,
    HBP_STATE_RUNNING = 3,
    HBP_STATE_FAULT = 4,
};

enum {
    HBP_COMMAND_ARM = 1,
    HBP_COMMAND_START = 2,
    HBP_COMMAND_STOP = 3,
    HBP_COMMAND_FAULT_CLEAR = 4,
};

enum {
    HBP_FAULT_WATCHDOG = 1, /* no ALIVE or SETPOINT in time */
    HBP_FAULT_OVERCURRENT = 2, /* a phase current beyond its limit */
    HBP_FAULT_OVERSPEED = 4, /* the shaft faster than allowed */
    HBP_FAULT_UNDERVOLTAGE = 8, /* DC link too low */
    HBP_FAULT_OVERVOLTAGE = 16, /* DC link too high */
    HBP_FAULT_HALL = 32, /* illegal codes or sequences from the Hall sensors */
    HBP_FAULT_INTERNAL = 64, /* the firmware's own */
    HBP_FAULT_OVERLOAD = 128, /* more current for longer than the winding bears */
};

enum {
    HBP_MODE_SPEED = 1, /* value: mechanical rad/s */
    HBP_MODE_CURRENT = 2, /* value: i_q in A, value2: i_d in A */
    HBP_MODE_TORQUE = 3, /* value: N·m (a load machine) */
    HBP_MODE_VOLTAGE = 4, /* value: u_q in V, value2: u_d in V (chapter 20) */
};

enum {
    HBP_STREAM_PWM = 0, /* a sample of the chosen channels every `decimation` PWM periods */
    HBP_STREAM_SLOW = 1, /* reserved for a task slower than the PWM */
    HBP_STREAM_EDGES = 2, /* every Hall edge */
    HBP_STREAM_MEAN = 3, /* the mean of the chosen channels over every `decimation` PWM periods */
};

enum {
    HBP_EVENT_STATE_CHANGED = 1, /* arg: the new DriveState */
    HBP_EVENT_FAULT = 2, /* arg: the bits that were added */
    HBP_EVENT_SETPOINT_REJECTED = 3, /* arg: the ErrorCode */
    HBP_EVENT_ARM_LAPSED = 4, /* arg: seconds that ARMED lasts */
    HBP_EVENT_PARAM_CHANGED = 5, /* arg: the parameter's id */
    HBP_EVENT_CAPTURED = 6, /* arg: the number of the capture that is now FROZEN */
};

enum {
    HBP_TRIGGER_OFF = 0, /* nothing: what is held is given up */
    HBP_TRIGGER_NOW = 1, /* the request itself */
    HBP_TRIGGER_ABOVE = 2, /* the channel is above `level` */
    HBP_TRIGGER_BELOW = 3, /* the channel is below `level` */
    HBP_TRIGGER_RISES = 4, /* the channel was not above `level` in the period before, and is now */
    HBP_TRIGGER_FALLS = 5, /* the channel was not below `level` in the period before, and is now */
    HBP_TRIGGER_CHANGES = 6, /* the channel has another raw value than in the period before */
    HBP_TRIGGER_FAULT = 7, /* a fault adds a bit to `faults` */
    HBP_TRIGGER_STATE = 8, /* the state changes */
    HBP_TRIGGER_ILLEGAL = 9, /* a Hall edge has the bit illegal */
    HBP_TRIGGER_PULSE = 10, /* a Hall edge takes back the edge before it, within `level` seconds */
};

enum {
    HBP_CAPTURE_OFF = 0, /* the device holds nothing and waits for nothing */
    HBP_CAPTURE_ARMED = 1, /* samples are taken, the trigger is awaited */
    HBP_CAPTURE_TRIGGERED = 2, /* the trigger has come, samples after it are still taken */
    HBP_CAPTURE_FROZEN = 3, /* the capture is complete, and blob 1 is it */
};

enum {
    HBP_TEST_OFF = 0,
    HBP_TEST_U_D = 1, /* the d voltage, after the loop */
    HBP_TEST_U_Q = 2, /* the q voltage, after the loop */
    HBP_TEST_I_D = 3, /* the reference of the d current */
    HBP_TEST_I_Q = 4, /* the reference of the q current */
    HBP_TEST_SPEED = 5, /* the reference of the speed, after the ramp */
};

enum {
    HBP_ERROR_UNKNOWN_TYPE = 1, /* detail: the type */
    HBP_ERROR_BAD_LENGTH = 2, /* detail: the payload's length */
    HBP_ERROR_BAD_VALUE = 3, /* detail: the value */
    HBP_ERROR_OUT_OF_RANGE = 4, /* detail: the limit */
    HBP_ERROR_WRONG_STATE = 5, /* detail: the state */
    HBP_ERROR_BAD_TOKEN = 6, /* detail: 0 */
    HBP_ERROR_UNKNOWN_ID = 7, /* detail: the id */
    HBP_ERROR_READ_ONLY = 8, /* detail: the id */
    HBP_ERROR_DOES_NOT_FIT = 9, /* detail: what would fit */
    HBP_ERROR_FAULTS_CHANGED = 10, /* detail: the faults now */
    HBP_ERROR_FAULT_PERSISTS = 11, /* detail: the faults whose cause is still there */
    HBP_ERROR_BUSY = 12, /* detail: what is busy */
    HBP_ERROR_BAD_VERSION = 13, /* detail: the major that the device speaks */
    HBP_ERROR_UNKNOWN_NODE = 14, /* detail: the node */
    HBP_ERROR_NOT_SUPPORTED = 15, /* detail: what was asked for */
    HBP_ERROR_STORE_FAILED = 16, /* detail: the device's own */
};

enum {
    HBP_RAW_U8 = 1,
    HBP_RAW_I8 = 2,
    HBP_RAW_U16 = 3,
    HBP_RAW_I16 = 4,
    HBP_RAW_U32 = 5,
    HBP_RAW_I32 = 6,
    HBP_RAW_F32 = 7,
};

enum {
    HBP_UNIT_NONE = 0,
    HBP_UNIT_RAD = 1,
    HBP_UNIT_RAD_PER_S = 2,
    HBP_UNIT_A = 3,
    HBP_UNIT_V = 4,
    HBP_UNIT_NM = 5,
    HBP_UNIT_S = 6,
    HBP_UNIT_HZ = 7,
    HBP_UNIT_OHM = 8,
    HBP_UNIT_H = 9,
    HBP_UNIT_VS = 10,
    HBP_UNIT_KGM2 = 11,
    HBP_UNIT_COUNT = 12,
    HBP_UNIT_PER_S = 13,
    HBP_UNIT_RAD_PER_S2 = 14,
    HBP_UNIT_RAD_PER_A = 15,
    HBP_UNIT_RAD_PER_AS = 16,
    HBP_UNIT_A_S_PER_RAD = 17,
    HBP_UNIT_A_PER_RAD = 18,
    HBP_UNIT_DEG_C = 19,
    HBP_UNIT_W = 20,
    HBP_UNIT_A2S = 21,
};

enum {
    HBP_FLAG_CHANNEL = 1, /* can be streamed */
    HBP_FLAG_PARAMETER = 2, /* can be read with PARAM_GET */
    HBP_FLAG_TRUTH = 4, /* the simulation's own state: no physical drive has it */
    HBP_FLAG_ESTIMATE = 8, /* a position or speed estimate, to be compared with the reference */
    HBP_FLAG_REFERENCE = 16, /* the position or speed that estimates are compared with (the encoder) */
    HBP_FLAG_WRAPS = 32, /* an angle in [-pi, pi) */
    HBP_FLAG_READ_ONLY = 64, /* a parameter that cannot be set */
    HBP_FLAG_IDLE_ONLY = 128, /* a parameter that can be set only while the outputs are off */
    HBP_FLAG_WHOLE = 256, /* a parameter that takes whole numbers only */
    HBP_FLAG_ON_REQUEST = 512, /* a channel that is streamed only where it is asked for by name */
    HBP_FLAG_IDENTITY = 1024, /* a parameter that tells which kind of motor this is */
    HBP_FLAG_CALIBRATION = 2048, /* a parameter that goes with this very motor, its sensors and their mounting */
    HBP_FLAG_TUNING = 4096, /* a parameter of taste: gains, filters, choices */
    HBP_FLAG_LIMITS = 8192, /* a parameter that protects */
    HBP_FLAG_VOLATILE = 16384, /* a parameter that is at its default at boot and whenever RUNNING has ended */
};
/* </codes> */

#define HBP_MAJOR 1
#define HBP_MINOR 1
#define HBP_STREAMS 4
#define HBP_KEPT 4 /* replies */
#define HBP_NONE 0xFFFFu

/* ---- what the application tells ------------------------------------------------------------------------------------------ */

/* A channel: a value in the structure that hbp_tick is given. Physical value = raw * scale + offset in `unit`. */
struct hbp_channel {
    uint16_t id;      /* unique among channels */
    uint8_t type;     /* HBP_RAW_U8 … HBP_RAW_F32 */
    uint8_t unit;     /* HBP_UNIT_… */
    uint16_t flags;   /* HBP_FLAG_ESTIMATE, HBP_FLAG_WRAPS, …; HBP_FLAG_CHANNEL goes without saying */
    uint16_t at;      /* offsetof() in the sample */
    float scale, offset;
    const char *name; /* 1 to 16 bytes, unique among channels */
};

struct hbp_parameter {
    uint16_t id;      /* unique among parameters */
    uint8_t unit;
    uint16_t flags;   /* HBP_FLAG_READ_ONLY, HBP_FLAG_IDLE_ONLY, HBP_FLAG_WHOLE, HBP_FLAG_VOLATILE, and its group */
    float lo, hi;     /* range, inclusive */
    float initial;    /* out of the box */
    float *value;     /* what the firmware computes with; unused where the configuration has `get` and `set` */
    const char *name; /* 1 to 16 bytes, unique among parameters; one named "watchdog", in s, sets the watchdog's time */
};

/* What a device is and does. Functions that return a uint16_t refuse with an HBP_ERROR_… code and a `detail`, or return 0. They are
 * called by hbp_rx and hbp_poll, with `user`. Those that may be missing (null) are marked so. */
struct hbp_config {
    uint8_t node;               /* 1 … ; on CAN at most 15 */
    uint8_t role;
    uint32_t features;          /* HBP_FEATURE_EDGES, HBP_FEATURE_COMMIT, HBP_FEATURE_MEANS */
    uint32_t tick_hz, pwm_hz;   /* ticks in a second, a multiple of pwm_hz; calls of hbp_tick in a second */
    uint64_t tick0;             /* tick of PWM period 0, the first call of hbp_tick: by it samples lie beside edges */
    const char *name, *firmware, *serial, *build; /* at most 16, 16, 24, 24 bytes; all but the name may be null */
    const struct hbp_channel *channels;
    const struct hbp_parameter *parameters;
    uint16_t n_channels, n_parameters;
    uint16_t sample_bytes;      /* sizeof of the structure that hbp_tick is given */
    void *user;
    uint16_t (*enter)(void *user, uint8_t state, float *detail); /* power stage on in RUNNING, at zero current, and off in all
                                                                    other states; may refuse ARMED and RUNNING */
    uint16_t (*setpoint)(void *user, uint8_t mode, float value, float value2, float *detail); /* finite numbers, in RUNNING */
    uint8_t (*outputs_on)(void *user);                          /* 1: the power stage is on, as the hardware has it */
    uint32_t (*clear)(void *user, uint32_t faults);             /* forget faults; those still there, or 0; or null */
    uint16_t (*commit)(void *user, float *detail);              /* store all parameters; or null */
    float (*get)(void *user, uint16_t k);                       /* value of parameters[k]; or null */
    uint16_t (*set)(void *user, uint16_t k, float value, float *detail); /* use it, it is within its range; or null */
    uint8_t *capture;           /* memory for captures, or null */
    uint32_t capture_bytes;     /* less than 2^31 */
    const uint16_t *fault_channels; /* ids of the channels that are held until a fault; or null: all without HBP_FLAG_ON_REQUEST */
    uint16_t n_fault_channels;
    const char *meanings;       /* what parameters and channels mean, "name meaning\n" for each (5.45 of SPEC); or null */
    int16_t *waveform;          /* samples of the test signal, which the host writes while the parameter "test" is 0; or null */
    uint16_t waveform_length;   /* how many, 256 at least */
};

/* ---- memory; nothing in it is the application's to write ----------------------------------------------------------------- */

struct hbp;
struct hbp_stream;
struct hbp_way;

struct hbp_reply { /* one that is kept */
    uint32_t request; /* its CRC-32 */
    uint16_t tid, length;
    uint8_t type, flags, transfer, there;
    uint8_t payload[(HBP_CAPTURE ? 66 : 26) + 2 * HBP_CHANNELS];
};

struct hbp_peer { /* a host */
    uint32_t nonce, used;
    uint16_t rx_max, tx_max;
    uint8_t number, greeted, oldest;
    struct hbp_reply kept[HBP_KEPT];
};

struct hbp_block { /* what stands before the records of a block */
    uint32_t index;
    uint16_t seq, n;
    uint32_t flags;
};

struct hbp_hall_edge {
    uint32_t index, tick;
    uint16_t encoder;
    uint8_t codes;
};

#if HBP_MEANS
struct hbp_mean { /* the periods of a channel since the last record */
    union {
        int64_t whole;
        double real; /* of an f32 */
    } first, total; /* the total, or that of the differences from the first where the channel wraps */
    double turn;    /* of an f32 that wraps; 0: it does not */
};
#endif

struct hbp_stream {
    /* the main loop's; the interrupt reads them while the stream runs */
    uint8_t number, configured, event, slot, pool, groups, counts_samples; /* frames of a block; on CAN, what `seq` is */
    volatile uint8_t running;
    uint8_t edge_flags, waits;
    uint8_t aligned, dropping, flags; /* the interrupt's */
    uint16_t decimation, latency_ms, cfg_id, record_bytes, block, channels;
    uint16_t stride;             /* words from block to block */
    uint16_t edge, edge_seq;     /* edge to be sent next, and the number of its frame */
    uint16_t filled, seq;        /* the interrupt's */
    uint32_t places;             /* blocks that there is room for */
    float rate;                  /* what it needs of the link */
    uint32_t lost;               /* frames dropped by the main loop */
    uint32_t read;               /* block to be sent next */
    uint32_t edge_index, since;  /* number that the next edge should have; tick at which the oldest that waits was seen */
    volatile uint32_t tail;      /* blocks taken */
    /* the interrupt's */
    uint32_t next, write;
    volatile uint32_t head;      /* blocks made */
    volatile uint32_t dropped;   /* frames for which there was no place */
    /* the main loop's, as above */
    uint16_t take[HBP_CHANNELS]; /* positions in the table of channels */
#if HBP_MEANS
    struct hbp_mean means[HBP_CHANNELS]; /* the interrupt's */
#endif
};

#if HBP_CAPTURE
struct hbp_run { /* bytes of a sample that stand side by side in a record, too */
    uint16_t at, bytes;
};

struct hbp_calls {
    uint8_t asked;  /* the main loop's: the trigger that has come; `asked_tick` when */
    uint8_t raised; /* hbp_raise's: a fault has come */
    uint8_t edged;  /* hbp_edge's: an edge is the trigger; `edge_tick` when */
    uint8_t fresh;  /* the main loop's: no period has come since the arming */
};

struct hbp_capture {
    volatile union {
        struct hbp_calls by;
        uint32_t any;
    } calls;                     /* what hbp_tick must look at */
    volatile uint8_t running;    /* the main loop's: the interrupts take records and edges; hbp_tick ends it */
    volatile uint8_t state;      /* the main loop's; hbp_tick makes ARMED TRIGGERED */
    /* the main loop's, and the interrupts' to read while `running` */
    uint8_t trigger;             /* as armed */
    uint8_t width;               /* of the channel that is watched, 0: none */
    /* hbp_tick's */
    uint8_t leaves;              /* 1: the range is that which must be left before the condition counts */
    uint8_t rounds, cause;       /* rounds of the ring of records: 0, 1, or more than one has been begun */
    /* hbp_edge's */
    uint8_t edge_wrapped, before_last;
    uint16_t edge_to;            /* where the next edge goes */
    uint16_t skip;               /* hbp_tick's: periods without a record before the next one */
    /* the main loop's, as above */
    uint16_t decimation, every, record_bytes, edge_room, at, channels, number; /* every: periods between two records */
    uint32_t turned;             /* bits of a negative value of that channel to be inverted */
    uint32_t low, span;          /* a value, made to fill 32 bits, fulfils the condition from `low` to `low + span` */
    uint8_t *records, *end;      /* the ring behind the edges */
    const struct hbp_run *runs_end;
    uint32_t ring_bytes;         /* of all records */
    uint32_t before, after;
    volatile uint32_t asked_tick, asked_faults;
    uint32_t pulse;              /* ticks */
    uint32_t room;               /* bytes of memory, 0: there is no capture */
    /* hbp_tick's */
    uint8_t *to;                 /* where the next record goes; `end`: the ring's beginning */
    uint32_t left;               /* records still to be taken after the trigger */
    uint32_t back;               /* records that had been taken from the trigger's on when it was seen */
    uint32_t faults;             /* at the trigger */
    uint32_t edges_begun;        /* edges before the first record of the ring was written last */
    uint64_t index;              /* of the trigger's record */
    /* hbp_edge's */
    uint32_t edge_tick, last_tick, lost_tick; /* of the trigger, of the last one, of the last one given up */
    uint32_t edge_end;           /* number of the edge after the last one */
    /* the main loop's */
    uint32_t start, edge_start;  /* of blob 1 in the rings, bytes */
    uint32_t summed;             /* bytes of it that are in the CRC */
    uint32_t told[12];           /* what the reply tells of a frozen one */
    struct hbp_run run[HBP_CHANNELS];
    uint16_t take[HBP_CHANNELS]; /* positions in the table of channels */
};
#endif

struct hbp { /* a device; what is used most stands in front, where a Cortex-M reaches it with instructions of 16 bits */
    const struct hbp_config *config;
    struct hbp_link_base *link;
    struct hbp_peer *peer; /* whose request is being answered, */
    float detail;          /* with this, where it is refused, */
    uint16_t answered;     /* or with so many bytes */
#if HBP_CAPTURE
    struct hbp_capture *capture; /* null: no memory for it */
#endif
    uint64_t now;
    uint8_t state;
    volatile uint8_t permit;
    uint16_t watchdog, test; /* positions of these parameters, HBP_NONE: there is none */
    uint16_t setpoint_counter, setpoints_rejected, last_tid, cfg_id;
    volatile uint16_t edge_head, edge_tail;
    volatile uint32_t edges; /* since boot */
    uint32_t features, boot_id, schema_crc, period; /* period: ticks of a PWM period */
    uint32_t faults, first_fault, dropped, beat;
    /* between main loop and interrupts */
    volatile uint32_t raised, seen; /* faults, with a count above them */
    volatile uint32_t leash, leash_ticks, runs; /* when the host was heard of, for how long that does, how often RUNNING began */
    volatile uint32_t cut;   /* the interrupt's: `runs` when the leash ran out */
    volatile uint32_t periods; /* the low bits of `index` */
    uint64_t index;          /* the interrupt's: PWM periods since boot */
    uint64_t fed, armed, next_heartbeat;
    struct hbp *other; /* the next one on the link */
#if HBP_CAPTURE
    struct hbp_capture captured;
#endif
    struct hbp_hall_edge ring[HBP_EDGES];
    struct hbp_peer peers[HBP_HOSTS];
    struct hbp_stream streams[HBP_STREAMS];
    uint32_t pools[HBP_POOLS][HBP_POOL_BYTES / 4];
};

struct hbp_link_base { /* what all kinds of link have */
    const struct hbp_way *way;
    struct hbp *first;
    uint32_t bad, ignored; /* damaged frames; frames that are replies themselves */
    volatile uint32_t expired; /* stream frames that waited too long, on CAN */
    float capacity;        /* what it carries, 0: not known */
    uint16_t most, most_news; /* bytes of a payload for which its queue has room: of a reply, of a LOG */
    uint8_t nodes;
    uint8_t *work;         /* where payloads are made: HBP_TX_MAX bytes, with room for a header before and a CRC behind them */
};

struct hbp_link { /* a byte link */
    struct hbp_link_base base;
    uint16_t decoded, encoded; /* bytes of the frame that is coming in */
    uint8_t code, left, skipping, broken;
    volatile uint32_t head, tail; /* bytes ever queued and taken */
    uint8_t rx[8 + HBP_RX_MAX + 4], made[8 + HBP_TX_MAX + 4]; /* frames */
    uint8_t tx[HBP_TX_BYTES];
};

/* ---- functions ----------------------------------------------------------------------------------------------------------- */

/* Why a device was not added; the lower 16 bits are the number of the channel or parameter, from 0. */
enum {
    HBP_WRONG_OPTIONS = 0x10000,         /* hbp.c was compiled with other options than the file that calls it */
    HBP_WRONG_NODE = 0x20000,            /* node 0, one that is there already, beyond 15 on CAN; or role 0 */
    HBP_WRONG_RATE = 0x30000,            /* tick_hz is no multiple of pwm_hz */
    HBP_WRONG_FUNCTION = 0x40000,        /* enter, setpoint or outputs_on is missing */
    HBP_WRONG_TEXT = 0x50000,            /* no name, or a text that is too long or has control characters */
    HBP_WRONG_COUNT = 0x60000,           /* more channels than HBP_CHANNELS */
    HBP_WRONG_BUS = 0x70000,             /* hbp_can_init */
    HBP_WRONG_CAPTURE = 0x80000,         /* too little memory for five records, or a wrong id in fault_channels */
    HBP_WRONG_WAVEFORM = 0x90000,        /* fewer than 256 samples */
    HBP_WRONG_CHANNEL_NAME = 0x110000,   /* empty or longer than 16 bytes */
    HBP_WRONG_CHANNEL_TYPE = 0x120000,   /* not one of HBP_RAW_… */
    HBP_WRONG_CHANNEL_SCALE = 0x130000,  /* 0, or not finite */
    HBP_WRONG_CHANNEL_PLACE = 0x140000,  /* it ends behind sample_bytes */
    HBP_WRONG_CHANNEL_TWICE = 0x150000,  /* its id or its name is another one's too */
    HBP_WRONG_PARAMETER_NAME = 0x210000, /* empty or longer than 16 bytes */
    HBP_WRONG_PARAMETER_RANGE = 0x220000, /* initial is not from lo to hi */
    HBP_WRONG_PARAMETER_VALUE = 0x230000, /* neither `value` nor `get` */
    HBP_WRONG_PARAMETER_TWICE = 0x240000, /* its id or its name is another one's too */
};

/* A byte link that carries `bytes_per_s` (a UART: baud / 10), 0 where that is not known. By it streams are refused that do not fit, and
 * those that do let no reply wait for long, however large the queue is. */
void hbp_link_init_sized(struct hbp_link *link, float bytes_per_s, size_t size);

static inline void hbp_link_init(struct hbp_link *link, float bytes_per_s)
{
    hbp_link_init_sized(link, bytes_per_s, sizeof *link);
}

/* Add a device; the first one answers to node 0. 0, or HBP_WRONG_…: then the device stays silent. */
uint32_t hbp_add_sized(struct hbp_link *link, struct hbp *device, const struct hbp_config *config, uint32_t boot_id, size_t size);

static inline uint32_t hbp_add(struct hbp_link *link, struct hbp *device, const struct hbp_config *config, uint32_t boot_id)
{
    return hbp_add_sized(link, device, config, boot_id, sizeof *link + sizeof *device);
}

/* Take bytes that have come, cut anywhere. `now`: 64-bit tick. */
void hbp_rx(struct hbp_link *link, uint64_t now, const uint8_t *data, size_t n);

/* Let time pass: watchdog, states, heartbeat; put frames into the transmit queue. At least once a millisecond. */
void hbp_poll(struct hbp_link *link, uint64_t now);

/* Bytes to be sent, in one piece, and how many; then say how many have gone. */
size_t hbp_tx_peek(const struct hbp_link *link, const uint8_t **bytes);
void hbp_tx_advance(struct hbp_link *link, size_t n);

/* PWM interrupt, each period: take a sample. */
void hbp_tick(struct hbp *device, const void *sample);

/* A Hall edge at `tick` (low 32 bits): Hall codes before and after, encoder count. */
void hbp_edge(struct hbp *device, uint32_t tick, uint8_t before, uint8_t after, uint16_t encoder);

/* PWM interrupt: 1 if the outputs may be on at `tick` (low 32 bits). 0 turns them off, whatever the main loop does. */
int hbp_may_run(struct hbp *device, uint32_t tick);

/* PWM interrupt: a fault was found (and the outputs are off). May be repeated each period. */
void hbp_raise(struct hbp *device, uint32_t faults);

/* Main loop: latch faults; the outputs go off. */
void hbp_fault(struct hbp *device, uint32_t faults);

/* Main loop: a line of text for people, control characters as spaces; `level` as syslog: 3 error, 4 warning, 6 information, 7 debug. */
void hbp_log(struct hbp *device, uint8_t level, const char *text);

#ifdef __cplusplus
}
#endif
#endif
