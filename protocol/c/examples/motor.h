/* motor.h: a small motor that exists on paper only, and what a drive with it tells `bench`. Shared by the examples.
 *
 * Before it is included: MOTOR_TICK_HZ, MOTOR_PWM_HZ. The PWM interrupt calls motor_period; all the rest is called by hbp.c. In a
 * firmware of your own, what stands here is split: the tables stay as they are, motor_period measures and controls.
 */
#ifndef MOTOR_H
#define MOTOR_H

#include "../hbp.h"

#include <string.h>

#define MOTOR_PERIOD (MOTOR_TICK_HZ / MOTOR_PWM_HZ)
#ifndef MOTOR_CAPTURE
#define MOTOR_CAPTURE 32768 /* bytes of memory for captures */
#endif
#define PI 3.14159265f
#define SPEED_SCALE 0.125f  /* electrical rad/s a count */
#define PER_AMPERE 300.0f   /* rad/s^2, mechanical */
#define FOLLOWS 0.05f       /* s, to a new speed */
#define COASTS 0.2f         /* s, until it stands */
#define ENCODER_SECTOR 128u /* counts in a Hall sector */

/* What the interrupt measures: one sample. */
struct sample {
    int16_t theta_enc, omega_enc, i_q, omega_ref, theta_avg, omega_avg;
    uint8_t hall, status;
};

static struct {
    /* the main loop's */
    volatile uint8_t state;
    volatile float wanted; /* mechanical rad/s */
    float n_p, i_max, omega_m_max, watchdog, hall_offset, hall_swap, hall_invert;
    /* the interrupt's */
    volatile uint8_t on;
    uint64_t now;       /* tick of the last sample */
    float omega, part;  /* mechanical rad/s; where it stands in its sector, 0 … 1 */
    uint8_t sector;     /* 0 … 5 */
    uint16_t encoder;   /* count at the sector's beginning */
    uint32_t edge_tick; /* of the last edge */
    float edge_angle, omega_avg;
} motor = {HBP_STATE_BOOT, 0.0f, 4.0f, 8.0f, 400.0f, 0.2f, 0.0f, 0.0f, 0.0f, 0, 0, 0.0f, 0.25f, 0, 0, 0, 0.0f, 0.0f};

static const struct hbp_channel motor_channels[] = {
    {1, HBP_RAW_U8, HBP_UNIT_NONE, 0, offsetof(struct sample, hall), 1.0f, 0.0f, "hall"},
    {2, HBP_RAW_U8, HBP_UNIT_NONE, 0, offsetof(struct sample, status), 1.0f, 0.0f, "status"},
    {3, HBP_RAW_I16, HBP_UNIT_RAD, HBP_FLAG_REFERENCE | HBP_FLAG_WRAPS, offsetof(struct sample, theta_enc), PI / 32768, 0.0f,
     "theta_enc"},
    {4, HBP_RAW_I16, HBP_UNIT_RAD_PER_S, HBP_FLAG_REFERENCE, offsetof(struct sample, omega_enc), SPEED_SCALE, 0.0f, "omega_enc"},
    {12, HBP_RAW_I16, HBP_UNIT_A, 0, offsetof(struct sample, i_q), 1.0f / 1024, 0.0f, "i_q"},
    {15, HBP_RAW_I16, HBP_UNIT_RAD_PER_S, 0, offsetof(struct sample, omega_ref), SPEED_SCALE, 0.0f, "omega_ref"},
    {16, HBP_RAW_I16, HBP_UNIT_RAD, HBP_FLAG_ESTIMATE | HBP_FLAG_WRAPS, offsetof(struct sample, theta_avg), PI / 32768, 0.0f,
     "theta_avg"},
    {17, HBP_RAW_I16, HBP_UNIT_RAD_PER_S, HBP_FLAG_ESTIMATE, offsetof(struct sample, omega_avg), SPEED_SCALE, 0.0f, "omega_avg"},
};

static const struct hbp_parameter motor_parameters[] = {
    {100, HBP_UNIT_NONE, HBP_FLAG_READ_ONLY | HBP_FLAG_WHOLE, 1.0f, 32.0f, 4.0f, &motor.n_p, "n_p"},
    {101, HBP_UNIT_A, 0, 0.5f, 10.0f, 8.0f, &motor.i_max, "i_max"},
    {102, HBP_UNIT_RAD_PER_S, 0, 1.0f, 600.0f, 400.0f, &motor.omega_m_max, "omega_m_max"},
    {103, HBP_UNIT_S, HBP_FLAG_IDLE_ONLY, 0.05f, 1.0f, 0.2f, &motor.watchdog, "watchdog"},
    {104, HBP_UNIT_RAD, HBP_FLAG_IDLE_ONLY, -PI, PI, 0.0f, &motor.hall_offset, "hall_offset"},
    {105, HBP_UNIT_NONE, HBP_FLAG_IDLE_ONLY | HBP_FLAG_WHOLE, 0.0f, 5.0f, 0.0f, &motor.hall_swap, "hall_swap_hat"},
    {106, HBP_UNIT_NONE, HBP_FLAG_IDLE_ONLY | HBP_FLAG_WHOLE, 0.0f, 7.0f, 0.0f, &motor.hall_invert, "hall_invert_hat"},
};

static const char motor_meanings[] =
    "theta_enc electrical angle of the shaft, from its encoder\n"
    "theta_avg electrical angle from the Hall edges and the mean speed between the last two\n"
    "i_q current that turns the shaft\n"
    "i_max largest current\n";

static uint8_t motor_memory[MOTOR_CAPTURE]; /* the last periods before a fault, or what a host asks for */

static uint16_t motor_enter(void *user, uint8_t state, float *detail)
{
    (void)user, (void)detail;
    motor.on = 0;
    motor.wanted = 0.0f;
    motor.state = state;
    motor.on = state == HBP_STATE_RUNNING;
    return 0;
}

static uint16_t motor_setpoint(void *user, uint8_t mode, float value, float value2, float *detail)
{
    (void)user, (void)value2;
    *detail = (float)mode;
    if (mode != HBP_MODE_SPEED) return HBP_ERROR_NOT_SUPPORTED;
    *detail = motor.omega_m_max;
    if (value > motor.omega_m_max || value < -motor.omega_m_max) return HBP_ERROR_OUT_OF_RANGE;
    motor.wanted = value;
    return 0;
}

static uint8_t motor_outputs_on(void *user)
{
    (void)user;
    return motor.on;
}

/* No hardware moves: SIMULATED spares the question before a motor is energised. Never set it where one can turn. */
static const struct hbp_config motor_config = {
    .node = 1, .role = HBP_ROLE_DRIVE, .features = HBP_FEATURE_EDGES | HBP_FEATURE_SIMULATED,
    .tick_hz = MOTOR_TICK_HZ, .pwm_hz = MOTOR_PWM_HZ, .tick0 = MOTOR_PERIOD,
    .name = MOTOR_NAME, .firmware = "1.0",
    .sample_bytes = sizeof(struct sample), .channels = motor_channels, .n_channels = sizeof motor_channels / sizeof motor_channels[0],
    .parameters = motor_parameters, .n_parameters = sizeof motor_parameters / sizeof motor_parameters[0],
    .enter = motor_enter, .setpoint = motor_setpoint, .outputs_on = motor_outputs_on,
    .capture = motor_memory, .capture_bytes = sizeof motor_memory, .meanings = motor_meanings,
};

static const uint8_t motor_pins[6] = {1, 3, 2, 6, 4, 5}; /* what the inputs read, by sector */

/* The Hall code where the inputs read `pins`: wires and polarities put right (SPEC 12). */
static uint8_t motor_code(uint8_t pins)
{
    static const uint8_t input_of[6][3] = {{0, 1, 2}, {1, 0, 2}, {0, 2, 1}, {2, 1, 0}, {1, 2, 0}, {2, 0, 1}};
    uint8_t code = 0, k;
    pins = (uint8_t)(pins ^ (int)motor.hall_invert);
    for (k = 0; k < 3u; k++) code = (uint8_t)(code | (pins >> input_of[(int)motor.hall_swap][k] & 1u) << k);
    return code;
}

/* The shaft has come to another sector, `way` is 1 or -1; that was `ago` ticks before this sample. */
static void motor_edge(struct hbp *drive, int way, float ago)
{
    uint8_t before = motor_code(motor_pins[motor.sector]);
    uint32_t tick = (uint32_t)motor.now - (uint32_t)ago, since = tick - motor.edge_tick;
    uint16_t encoder = motor.encoder;
    motor.sector = (uint8_t)((motor.sector + 6 + way) % 6);
    motor.encoder = (uint16_t)(motor.encoder + way * (int)ENCODER_SECTOR);
    if (way > 0) encoder = motor.encoder;
    motor.edge_angle = (float)(way > 0 ? motor.sector : motor.sector + 1) * (PI / 3);
    motor.omega_avg = (float)way * (PI / 3) * MOTOR_TICK_HZ / (float)(since ? since : 1u);
    motor.edge_tick = tick;
    hbp_edge(drive, tick, before, motor_code(motor_pins[motor.sector]), encoder);
}

static int16_t motor_raw(float value)
{
    return (int16_t)(value > 32767.0f ? 32767 : value < -32768.0f ? -32768 : (int)value);
}

/* [-pi, pi) as the whole range of an i16. */
static int16_t motor_angle(float angle)
{
    return (int16_t)(uint16_t)(int32_t)(angle * (32768.0f / PI));
}

/* The PWM interrupt: look at the time, turn the shaft for one period, tell. */
static inline void motor_period(struct hbp *drive)
{
    const float seconds = 1.0f / MOTOR_PWM_HZ;
    float i_q = 0.0f, step, since;
    struct sample sample;
    motor.now += MOTOR_PERIOD;
    if (!hbp_may_run(drive, (uint32_t)motor.now)) motor.on = 0;
    if (motor.on) {
        i_q = (motor.wanted - motor.omega) / (FOLLOWS * PER_AMPERE);
        if (i_q > motor.i_max) i_q = motor.i_max;
        if (i_q < -motor.i_max) i_q = -motor.i_max;
        motor.omega += i_q * PER_AMPERE * seconds;
    } else {
        motor.omega -= motor.omega * seconds / COASTS;
        if (motor.omega < 0.01f && motor.omega > -0.01f) motor.omega = 0.0f;
    }
    if (motor.omega > 1.2f * motor.omega_m_max || motor.omega < -1.2f * motor.omega_m_max) {
        motor.on = 0;
        if (motor.state == HBP_STATE_RUNNING) hbp_raise(drive, HBP_FAULT_OVERSPEED);
    }
    step = motor.omega * motor.n_p * seconds * (3 / PI);
    motor.part += step;
    while (motor.part >= 1.0f) {
        motor.part -= 1.0f;
        motor_edge(drive, 1, motor.part / step * MOTOR_PERIOD);
    }
    while (motor.part < 0.0f) {
        float beyond = motor.part;
        motor.part = beyond > -1e-6f ? 0.999999f : beyond + 1.0f; /* never 1 by rounding */
        motor_edge(drive, -1, beyond / step * MOTOR_PERIOD);
    }
    since = (float)((uint32_t)motor.now - motor.edge_tick) / MOTOR_TICK_HZ;
    if (motor.omega_avg * since > PI / 3 || motor.omega_avg * since < -PI / 3) motor.omega_avg = 0.0f; /* it has become slower */
    sample.hall = motor_code(motor_pins[motor.sector]);
    sample.status = motor.state;
    sample.theta_enc = motor_angle(((float)motor.sector + motor.part) * (PI / 3));
    sample.omega_enc = motor_raw(motor.omega * motor.n_p / SPEED_SCALE);
    sample.i_q = motor_raw(i_q * 1024);
    sample.omega_ref = motor_raw(motor.wanted * motor.n_p / SPEED_SCALE);
    sample.theta_avg = motor_angle(motor.hall_offset + motor.edge_angle + motor.omega_avg * since);
    sample.omega_avg = motor_raw(motor.omega_avg / SPEED_SCALE);
    hbp_tick(drive, &sample);
}

#endif
