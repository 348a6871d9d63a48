/* The vector-tracking position observer (3)-(10) in 16-bit fixed point, for the firmware of a drive with Hall sensors.
 *
 * S.-Y. Kim, C. Choi, K. Lee, W. Lee, "An Improved Rotor Position Estimation With Vector-Tracking Observer in PMSM
 * Drives With Low-Resolution Hall-Effect Sensors", IEEE Trans. Ind. Electron., 2011, DOI 10.1109/TIE.2010.2098367.
 *
 * One control period is one call of hbq_step. It needs no library, no memory but its arguments, no 64-bit integer and no
 * floating point, overflows nothing whatever it is given within the ranges below, and never blocks. It neither reads a
 * Hall pin nor measures the time between edges: a capture unit's driver does (README.md).
 *
 * Angles: 2^16 or 2^32 is one electrical turn, unsigned, 0 where the rotor's flux lies on phase a. Speeds: electrical turns times
 * 2^32 a control period, signed, at most an eighth of a turn. Voltages and currents: 2^15 is the base that the constants
 * were made for.
 *
 * Not thread-safe for one state; states are independent.
 */
#ifndef HBQ_VECTOR_TRACKING_Q15_H
#define HBQ_VECTOR_TRACKING_Q15_H

#include <stdint.h>

#define HBQ_TURN_MAX 536870911 /* 2^29 - 1: an eighth of a turn a period, the largest speed, gain and integral */

/* Constants; README.md says how they are made. */
typedef struct {
    int16_t z_now;    /* (L_s / T_s + R_s / 2) * 2^z_shift * base_i / base_u, 0..32767 */
    int16_t z_before; /* (L_s / T_s - R_s / 2) likewise, at most z_now in size */
    int16_t z_shift;  /* 0..15 */
    int16_t a_min;    /* T_s / (T_s + tau_max) * 2^15, 1..32767 */
    int32_t k_p;      /* k_p T_s / (2 pi) * 2^32, 0..HBQ_TURN_MAX */
    int32_t k_i;      /* k_i T_s^2 / (2 pi) * 2^32, 0..HBQ_TURN_MAX */
    int32_t turn_on;  /* omega_on T_s / (2 pi) * 2^32, 0..HBQ_TURN_MAX: the correction starts */
    int32_t turn_off; /* omega_off T_s / (2 pi) * 2^32, 0..HBQ_TURN_MAX: it stops */
    int32_t e_min;    /* psi_f omega_on / base_u * 2^30, 4..2^30 - 1 */
    int32_t e_turn;   /* psi_f omega_off / (2 base_u) * 2^30, 0..2^30 - 1 */
    int16_t a_omega;  /* (1 - exp(-2 pi f T_s)) * 2^15 of the speed filter's cut-off f, 1..32767 */
    uint32_t hall_offset; /* angle at which the Hall sector 0 opens */
} hbq_params_t;

/* One control period. */
typedef struct {
    int16_t u_alpha; /* reference voltage in force over the period that ends at the sample, -32767..32767; */
    int16_t u_beta;  /* both are 0 when and only when the outputs are off */
    int16_t i_alpha; /* current at the sample, -32767..32767 */
    int16_t i_beta;
    int32_t turn_h;     /* average speed by (1) from the last two edges, bounded while an edge is overdue; 0: unknown */
    uint16_t theta_avg; /* angle by the edges alone, (2); the sector's centre while no edge was passed */
    int16_t sector;     /* 0..5; -1: not known yet */
    int16_t direction;  /* of the last edge: 1, -1; 0: unknown */
    int16_t edge;       /* 1: an edge between neighbouring sectors was passed in the period; else 0 */
} hbq_sample_t;

/* What the observer remembers; the results of a period are among it. */
typedef struct {
    int16_t primed;    /* 1: the fields below hold a past sample */
    int16_t on;        /* result. 1: the correction is at work */
    int16_t direction; /* of the rotor, while it is: 1 or -1 */
    int16_t i_alpha;   /* of the last sample */
    int16_t i_beta;
    int32_t e_alpha; /* filtered back-EMF; 2^30 is base_u */
    int32_t e_beta;
    uint32_t theta; /* result. Angle at the sample; its upper 16 bits are the 16-bit angle */
    int32_t corr_i; /* integral part of (9), a speed */
    int32_t omega;  /* result. Speed, low-pass filtered */
} hbq_state_t;

/* Nothing known: the next sample gives the first currents and the angle by the Hall sector. */
void hbq_init(hbq_state_t *state);

/* One control period. */
void hbq_step(const hbq_params_t *params, hbq_state_t *state, const hbq_sample_t *sample);

#endif
