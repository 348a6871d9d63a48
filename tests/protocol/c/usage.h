/* What the usage in hbp.h takes for granted. */
#include "hbp.h"
void power_stage(int on); uint8_t power_stage_is_on(void); void use_speed(float omega_m); uint32_t random_number(void);
size_t uart_received(const uint8_t **bytes); size_t uart_send(const uint8_t *bytes, size_t n); uint64_t ticks(void);
uint32_t timer(void); void measure_and_control(void *sample); uint32_t captured(void); uint8_t code_before(void);
uint8_t code_after(void); uint16_t encoder(void); void pwm_interrupt(void); void capture_interrupt(void);
#define FIRST_TICK 8500
