/* main.c: a bare-metal drive on a Cortex-M4F, as QEMU emulates one (board mps2-an386). `make run` starts it; QEMU tells which
 * pseudo-terminal its serial port is at: bench info serial:/dev/pts/3.
 *
 * Timer 0 interrupts once in a PWM period, timer 1 runs freely and is the clock of all ticks. The serial port receives by interrupt
 * into a ring; the main loop sends.
 */
#include "mps2.h"

#define MOTOR_TICK_HZ CLOCK_HZ
#define MOTOR_PWM_HZ 1000u
#define MOTOR_NAME "mps2-an386"

#include "../motor.h"

#define RING 256u       /* a power of two */
#define AT_A_TIME 512u  /* bytes sent before the main loop looks round again */

static struct hbp_link link;
static struct hbp drive;
static volatile uint8_t ring[RING];
static volatile uint32_t ring_head, ring_tail;

static uint32_t ticks(void)
{
    return ~TIMER1->value; /* it counts down */
}

/* The PWM interrupt. An emulator may come late: all periods that are due are made up for. */
void timer0_interrupt(void);
void timer0_interrupt(void)
{
    TIMER0->interrupt = 1;
    while ((int32_t)(ticks() - (uint32_t)motor.now) >= (int32_t)MOTOR_PERIOD) motor_period(&drive);
}

static void take_in(void)
{
    while ((UART0->state & UART_RX_FULL) && ring_head - ring_tail < RING) {
        ring[ring_head % RING] = (uint8_t)UART0->data;
        ring_head = ring_head + 1u;
    }
}

void uart0_rx_interrupt(void);
void uart0_rx_interrupt(void)
{
    UART0->interrupt = 2;
    take_in();
}

static uint64_t now(void)
{
    uint64_t tick;
    __asm volatile("cpsid i" ::: "memory");
    tick = motor.now;
    __asm volatile("cpsie i" ::: "memory");
    return tick;
}

static void receive(void)
{
    uint8_t bytes[64];
    size_t n = 0;
    while (n < sizeof bytes && ring_tail != ring_head) {
        bytes[n++] = ring[ring_tail % RING];
        ring_tail = ring_tail + 1u;
    }
    __asm volatile("cpsid i" ::: "memory");
    take_in(); /* a byte that found the ring full interrupts no second time */
    __asm volatile("cpsie i" ::: "memory");
    if (n) hbp_rx(&link, now(), bytes, n);
}

/* 1: nothing is left to be sent, or the port takes no more for now. */
static int transmit(void)
{
    const uint8_t *bytes;
    for (unsigned sent = 0; sent < AT_A_TIME; sent++) {
        if (!hbp_tx_peek(&link, &bytes) || (UART0->state & UART_TX_FULL)) return 1;
        UART0->data = *bytes;
        hbp_tx_advance(&link, 1);
    }
    return 0;
}

static void sleep_until_interrupt(void)
{
    __asm volatile("cpsid i" ::: "memory");
    if (ring_head == ring_tail) __asm volatile("wfi"); /* an interrupt ends it, though it is served only below */
    __asm volatile("cpsie i" ::: "memory");
}

int main(void)
{
    hbp_link_init(&link, 0.0f);
    if (hbp_add(&link, &drive, &motor_config, BOOT_WORD)) return 1;
    UART0->divider = 16;
    UART0->control = UART_TX_ON | UART_RX_ON | UART_RX_INTERRUPT;
    TIMER1->reload = TIMER1->value = 0xFFFFFFFFu;
    TIMER1->control = TIMER_ON;
    TIMER0->reload = TIMER0->value = MOTOR_PERIOD - 1u;
    TIMER0->control = TIMER_ON | TIMER_INTERRUPT;
    NVIC_PRIORITY[UART0_RX_NUMBER] = 0x40; /* below the PWM */
    NVIC_ENABLE = 1u << UART0_RX_NUMBER | 1u << TIMER0_NUMBER;
    for (;;) {
        receive();
        hbp_poll(&link, now());
        if (transmit()) sleep_until_interrupt();
    }
}
