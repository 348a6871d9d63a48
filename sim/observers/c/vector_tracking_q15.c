/* See vector_tracking_q15.h. Equation numbers are those of the paper named there. */
#include "vector_tracking_q15.h"

#define ONE 32768                     /* of Q15 */
#define HALF 16384                    /* of Q15; one of Q14 */
#define LIMIT_16 32767
#define HALF_TURN 0x80000000u
#define QUARTER_TURN 0x40000000u
#define TWELFTH 357913941             /* of a turn: 30 degrees */
#define GUARD 715827882               /* 60 degrees from the sector's centre: the estimate is not believed beyond */
#define OMEGA_MAX 1073741823          /* 2^30 - 1, largest sum of speeds */
#define RAD 25736                     /* Q15 rad in an eighth of a turn */
#define QUARTER 128                   /* intervals of the table */

typedef struct {
    int16_t alpha;
    int16_t beta;
} vector_t;

/* 2^15 sin(k / 128 * 90 degrees), rounded, at most 2^15 - 1. */
static const int16_t SINE[QUARTER + 1] = {
    0, 402, 804, 1206, 1608, 2009, 2411, 2811, 3212, 3612, 4011, 4410, 4808, 5205, 5602, 5998,
    6393, 6787, 7180, 7571, 7962, 8351, 8740, 9127, 9512, 9896, 10279, 10660, 11039, 11417, 11793, 12167,
    12540, 12910, 13279, 13646, 14010, 14373, 14733, 15091, 15447, 15800, 16151, 16500, 16846, 17190, 17531, 17869,
    18205, 18538, 18868, 19195, 19520, 19841, 20160, 20475, 20788, 21097, 21403, 21706, 22006, 22302, 22595, 22884,
    23170, 23453, 23732, 24008, 24279, 24548, 24812, 25073, 25330, 25583, 25833, 26078, 26320, 26557, 26791, 27020,
    27246, 27467, 27684, 27897, 28106, 28311, 28511, 28707, 28899, 29086, 29269, 29448, 29622, 29792, 29957, 30118,
    30274, 30425, 30572, 30715, 30853, 30986, 31114, 31238, 31357, 31471, 31581, 31686, 31786, 31881, 31972, 32058,
    32138, 32214, 32286, 32352, 32413, 32470, 32522, 32568, 32610, 32647, 32679, 32706, 32729, 32746, 32758, 32766,
    32767};

static int32_t clip(int32_t value, int32_t limit)
{
    if (value > limit) {
        return limit;
    }
    return (value < -limit) ? -limit : value;
}

static int32_t size_of(int32_t value)
{
    return (value < 0) ? -value : value;
}

/* value / 2^shift, rounded down; C99 leaves it to the compiler what >> makes of a negative value. */
static int32_t down(int32_t value, int16_t shift)
{
    return (value >= 0) ? (value >> shift) : ~(~value >> shift);
}

/* An angle, or a difference of two, as turns in [-2^31, 2^31). */
static int32_t as_signed(uint32_t angle)
{
    return (angle < HALF_TURN) ? (int32_t)angle : (-(int32_t)(UINT32_MAX - angle) - 1);
}

/* x k, k in Q15 and not -2^15, rounded half up: two products of 16 by 16 bits. */
static int32_t times(int32_t x, int16_t k)
{
    const int32_t high = down(x, 16);
    const int32_t low = (int32_t)((uint32_t)x & 0xFFFFu);
    return 2 * (high * k) + down(low * k + HALF, 15);
}

/* n / d, d positive, rounded half away from zero. */
static int32_t ratio(int32_t n, int16_t d)
{
    const int32_t size = (size_of(n) + (d >> 1)) / d;
    return (n >= 0) ? size : -size;
}

/* Square root, rounded down, of 0 <= n < 2^30: a bit of the result a turn. */
static int16_t root(int32_t n)
{
    int32_t found = 0;
    int32_t bit;
    for (bit = HALF; bit > 0; bit >>= 1) {
        if ((found + bit) * (found + bit) <= n) {
            found += bit;
        }
    }
    return (int16_t)found;
}

/* Sine in Q15, straight between the points of the table. */
static int16_t sine(uint32_t angle)
{
    uint32_t a = angle & (HALF_TURN - 1u);
    uint32_t k;
    int32_t value;
    if (a > QUARTER_TURN) {
        a = HALF_TURN - a;
    }
    k = a >> 23;
    value = SINE[k];
    if (k < QUARTER) {
        value += ((SINE[k + 1u] - value) * (int32_t)((a >> 8) & LIMIT_16) + HALF) >> 15;
    }
    return (int16_t)((angle < HALF_TURN) ? value : -value);
}

static int16_t cosine(uint32_t angle)
{
    return sine(angle + QUARTER_TURN);
}

/* (5): mean back-EMF of a period. */
static int16_t back_emf(const hbq_params_t *p, int16_t u, int16_t i, int16_t i_before)
{
    const int32_t sum = (int32_t)p->z_now * i - (int32_t)p->z_before * i_before;
    const int32_t drop = down(sum + (((int32_t)1 << p->z_shift) >> 1), p->z_shift);
    return (int16_t)clip(u - drop, LIMIT_16);
}

/* Gain of (6), Q15: T_s / (T_s + tau) with tau = min(tau_max, 1 / |omega_h|). */
static int16_t filter_gain(const hbq_params_t *p, int32_t speed)
{
    const int32_t x = ((speed >> 14) * RAD) >> 15; /* T_s |omega_h|, rad */
    const int32_t a = (x * ONE) / (ONE + x);
    return (int16_t)((a > p->a_min) ? a : p->a_min);
}

/* How far 0 <= size < 2^30 is to be shifted down to fit into 15 bits: 0..15. */
static int16_t shift_for(int32_t size)
{
    int32_t above = size >> 15;
    int16_t shift = 0;
    int16_t part;
    for (part = 8; part > 0; part = (int16_t)(part >> 1)) {
        if ((above >> part) > 0) {
            above >>= part;
            shift = (int16_t)(shift + part);
        }
    }
    return (int16_t)(shift + above);
}

/* The filter's inverse (1 - (1 - a) e^-jx) / a, x = T_s omega_h, on a vector; a quarter of the result.
 * With h = x / 2 and t = 2 (1 - a) sin(h) / a the inverse is 1 + t sin(h) + j t cos(h); t is at most 1. */
static vector_t undo_filter(int16_t a, int32_t turn_h, int32_t e_alpha, int32_t e_beta)
{
    const uint32_t h = (uint32_t)size_of(turn_h) >> 1;
    const int16_t sin_h = sine(h);
    const int32_t t = clip(ratio((int32_t)(ONE - a) * sin_h, a), HALF); /* Q14 */
    const int32_t re = HALF + times(t, sin_h);
    const int32_t size = times(t, cosine(h));
    const int32_t im = (turn_h < 0) ? -size : size;
    vector_t f;
    f.alpha = (int16_t)down(re * e_alpha - im * e_beta + ONE, 16);
    f.beta = (int16_t)down(re * e_beta + im * e_alpha + ONE, 16);
    return f;
}

/* (7)-(10): one period with the correction at work; the speed before its filter. */
static int32_t correct(const hbq_params_t *p, hbq_state_t *s, int16_t a, int32_t turn_h)
{
    const int16_t shift = shift_for(size_of(s->e_alpha) | size_of(s->e_beta) | p->e_min);
    const vector_t f = undo_filter(a, turn_h, down(s->e_alpha, shift), down(s->e_beta, shift));
    const int16_t f_shift = (int16_t)(shift + 2);
    const uint32_t theta_mid = s->theta + (uint32_t)down(turn_h + s->corr_i, 1);
    const int32_t cos_mid = cosine(theta_mid);
    const int32_t sin_mid = sine(theta_mid);
    const int32_t e_q = down(f.beta * cos_mid - f.alpha * sin_mid, 15);
    const int16_t length = root((int32_t)f.alpha * f.alpha + (int32_t)f.beta * f.beta);
    const int32_t least = p->e_min >> f_shift;
    int32_t omega = turn_h;
    int32_t cross;
    int16_t error;
    if (e_q * s->direction < -(p->e_turn >> f_shift)) {
        s->direction = (int16_t)-s->direction;
    }
    if (((turn_h < 0) && (s->direction > 0)) || ((turn_h > 0) && (s->direction < 0))) {
        omega = 0;
    }
    /* sin(theta_hat - theta*) times the sign of the speed */
    cross = ratio(f.alpha * cos_mid + f.beta * sin_mid, (int16_t)((length > least) ? length : least));
    error = (int16_t)(-clip(cross, LIMIT_16) * s->direction);
    s->corr_i = clip(s->corr_i + times(p->k_i, error), HBQ_TURN_MAX);
    omega = clip(omega + times(p->k_p, error) + s->corr_i, OMEGA_MAX);
    s->theta += (uint32_t)omega;
    return omega;
}

void hbq_init(hbq_state_t *state)
{
    static const hbq_state_t nothing = {0, 0, 0, 0, 0, 0, 0, 0u, 0, 0};
    *state = nothing;
}

void hbq_step(const hbq_params_t *params, hbq_state_t *state, const hbq_sample_t *sample)
{
    const int32_t turn_h = clip(sample->turn_h, HBQ_TURN_MAX);
    const int32_t speed = size_of(turn_h);
    const uint32_t theta_avg = (uint32_t)sample->theta_avg << 16;
    const uint32_t middle = (uint32_t)(2 * sample->sector + 1) * (uint32_t)TWELFTH + params->hall_offset;
    const int driven = (sample->u_alpha != 0) || (sample->u_beta != 0);

    if (state->primed == 0) {
        hbq_init(state);
        state->primed = 1;
        state->theta = theta_avg;
        state->omega = turn_h;
    } else {
        /* (5), (6) */
        const int16_t a = filter_gain(params, speed);
        const int32_t e_alpha = back_emf(params, sample->u_alpha, sample->i_alpha, state->i_alpha) * ONE;
        const int32_t e_beta = back_emf(params, sample->u_beta, sample->i_beta, state->i_beta) * ONE;
        int32_t omega = turn_h;
        state->e_alpha += times(e_alpha - state->e_alpha, a);
        state->e_beta += times(e_beta - state->e_beta, a);

        if ((state->on == 1) && driven && (speed >= params->turn_off)) {
            int32_t off;
            omega = correct(params, state, a, turn_h);
            off = as_signed(state->theta - middle);
            if ((off > GUARD) || (off < -GUARD)) {
                state->on = 0;
                state->corr_i = 0;
                state->theta = theta_avg;
                omega = turn_h;
            }
        } else {
            state->on = 0;
            state->corr_i = 0;
            if ((sample->edge == 1) || (turn_h == 0)) {
                state->theta = theta_avg;
                state->direction = sample->direction;
                if ((sample->edge == 1) && driven && (speed >= params->turn_on)) {
                    state->on = 1; /* at work from the next sample on */
                }
            } else { /* with omega_h, inside the sector */
                const int32_t off = as_signed(state->theta + (uint32_t)turn_h - middle);
                state->theta = middle + (uint32_t)clip(off, TWELFTH);
            }
        }
        state->omega += times(omega - state->omega, params->a_omega);
    }
    state->i_alpha = sample->i_alpha;
    state->i_beta = sample->i_beta;
}
